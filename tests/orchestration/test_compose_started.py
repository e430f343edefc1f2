"""deploy/compose, started: each service runs its command line with its files mounted,
as its user, on a read-only root and in a network of its own, without a container
engine and its images. PostgreSQL, Envoy and Prometheus are those of this machine.
Grafana is left out: there is none for Debian 12."""

import contextlib
import itertools
import json
import os
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time

import pytest
import yaml

ROOT = pathlib.Path(__file__).resolve().parents[2]
BIN = pathlib.Path(os.environ["REVISIT_BIN"])
DRIVE = ROOT / "tests/data/boreas/boreas_glen_shields.csv"
CONSOLE = ROOT / "client/console/dist"
SERVERS = [f"revisitd-{number}" for number in (1, 2, 3)]
START_SECONDS = 60

sys.path.insert(0, str(ROOT / "deploy/cluster"))
from private_cluster import Processes, find_postgres  # noqa: E402


def find(variable, pattern):
    """A program that tests/run has made or installed; None without it."""
    named = os.environ.get(variable)
    found = [named] if named else sorted(map(str, ROOT.glob(pattern)))
    return pathlib.Path(found[-1]) if found else None


ENVOY = find("REVISIT_TEST_ENVOY",
             "build/python/lib/python3*/site-packages/envoy/_bin/envoy")
PROMETHEUS = find("REVISIT_TEST_PROMETHEUS", "build/tools/prometheus")


def image_environment(file):
    """Variables that an image sets for those who run it."""
    text = (ROOT / "deploy/image" / file).read_text()
    return dict(re.findall(r"(REVISIT_\w+)=(\S+)",
                           text[text.index("\nENV REVISIT_"):]))


def do(*command, **more):
    result = subprocess.run([*map(str, command)], capture_output=True, text=True,
                            check=False, **more)
    assert result.returncode == 0, f"{command}\n{result.stderr}{result.stdout}"
    return result.stdout


def wait_until(condition, what, *processes):
    deadline = time.monotonic() + START_SECONDS
    while not (value := condition()):
        for process in processes:
            process.check()
        assert time.monotonic() < deadline, f"no {what}"
        time.sleep(0.1)
    return value


class Network:
    """The network of the services, each of which has a name space of its own there.
    A context manager that removes them."""

    def __init__(self):
        self._prefix = f"revisit{os.getpid()}"
        self._spaces = []
        self._bridge = self._add("bridge")
        do("ip", "-n", self._bridge, "link", "add", "bridge", "type", "bridge")
        do("ip", "-n", self._bridge, "link", "set", "bridge", "up")

    def _add(self, name):
        space = f"{self._prefix}-{name}"
        do("ip", "netns", "add", space)
        self._spaces.append(space)
        do("ip", "-n", space, "link", "set", "lo", "up")
        return space

    def join(self, name, address):
        """A name space with this address; answers what a command in it begins with."""
        space = self._add(name)
        port = f"port{len(self._spaces)}"
        do("ip", "-n", space, "link", "add", "eth0", "type", "veth", "peer", "name",
           port, "netns", self._bridge)
        do("ip", "-n", self._bridge, "link", "set", port, "master", "bridge", "up")
        do("ip", "-n", space, "address", "add", f"{address}/24", "dev", "eth0")
        do("ip", "-n", space, "link", "set", "eth0", "up")
        return ["ip", "netns", "exec", space]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for space in self._spaces:
            subprocess.run(["ip", "netns", "delete", space], check=False)


class Container:
    """A service of the file, with what its image would have."""

    def __init__(self, compose, name, programs, environment=None):
        self.service = compose.services[name]
        self._programs = programs
        self._environment = {"PATH": "/usr/bin:/opt", **(environment or {}),
                             **self.service.get("environment", {})}
        self._user, _, self._group = self.service.get(
            "user", "10001:10001").partition(":")
        self._launch = compose.network.join(name, compose.addresses[name])
        self._root = compose.directory / name
        for folder in ("usr", "opt", "proc", "sys", "dev", "etc", "tmp", "run",
                       "var"):
            (self._root / folder).mkdir(parents=True)
        for link in ("bin", "lib", "lib64", "sbin"):
            (self._root / link).symlink_to(f"usr/{link}")
        for file in ("passwd", "group", "nsswitch.conf", "ld.so.cache"):
            shutil.copy(f"/etc/{file}", self._root / "etc")
        names = {**compose.addresses,
                 self.service.get("hostname", name): compose.addresses[name]}
        (self._root / "etc/hosts").write_text("127.0.0.1 localhost\n" + "".join(
            f"{address} {host}\n" for host, address in names.items()))

    def _mounts(self):
        """Commands that mount its files below its root."""
        root = self._root
        yield f"mount --bind {root} {root}"
        yield f"mount --bind /usr {root}/usr"
        yield f"mount --rbind /proc {root}/proc"
        # Containers have /sys, and gRPC relies on it: Abseil counts processors there
        # when a mutex is first contended, and a missing file sets errno, which gRPC may
        # be about to read after its connect(). Now and then a client would find a
        # server unavailable that is there.
        yield f"mount --rbind --options ro /sys {root}/sys"
        yield f"mount --rbind /dev {root}/dev"
        for program in self._programs:
            make = "mkdir -p" if program.is_dir() else "touch"
            yield f"{make} {root}/opt/{program.name}"
            yield f"mount --bind {program} {root}/opt/{program.name}"
        for entry in self.service.get("tmpfs", ()):
            path, _, options = entry.partition(":")
            yield f"mkdir -p {root}{path}"
            yield f"mount -t tmpfs -o {options or 'mode=1777'} tmpfs {root}{path}"
        for volume in self.service.get("volumes", ()):
            source, target, *_ = volume.split(":")
            if not source.startswith("/"):
                # A volume of the file's own, which the image's user may write.
                yield f"mkdir -p {root}{target} && chown {self._user} {root}{target}"
                yield f"mount -t tmpfs -o uid={self._user} tmpfs {root}{target}"
                continue
            place = f"{root}{target}"
            if os.path.isdir(source):
                yield f"mkdir -p {place}"
            else:
                yield f"mkdir -p {os.path.dirname(place)} && touch {place}"
            yield f"mount --bind {source} {place}"
            yield f"mount -o remount,bind,ro {place}"
        assert self.service["read_only"]
        yield f"mount -o remount,bind,ro {root}"

    def command(self, *program):
        """A command in it, as its user and without rights."""
        assert self.service["cap_drop"] == ["ALL"]
        inside = ["chroot", self._root, "setpriv", f"--reuid={self._user}",
                  f"--regid={self._group}", "--clear-groups", "--inh-caps=-all",
                  "--bounding-set=-all", "--no-new-privs", "env", "-i",
                  *(f"{name}={value}" for name, value in self._environment.items()),
                  *program]
        script = "set -e\n" + "\n".join(self._mounts()) + '\nexec "$@"\n'
        return [*self._launch, "unshare", "--mount", "--propagation", "private",
                "bash", "-c", script, "bash", *inside]


class Compose:
    """All of it. A context manager that stops it."""

    def __init__(self, services, network, processes):
        self.services = services
        self.network = network
        self.directory = processes.directory
        self.processes = processes
        free = (f"10.71.0.{host}" for host in itertools.count(100))
        self.addresses = {
            name: service["networks"]["backend"]["ipv4_address"]
            if isinstance(service["networks"], dict)
            and (service["networks"]["backend"] or {}).get("ipv4_address")
            else next(free) for name, service in services.items()}

    def start(self):
        self._start_database()
        ours = [BIN / "revisitd", BIN / "revisit"]
        image = image_environment("Containerfile")
        migrate = Container(self, "migrate", ours, image)
        do(*migrate.command("revisitd", *migrate.service["command"]))
        self.servers = {name: Container(self, name, ours, image)
                        for name in SERVERS}
        for name, server in self.servers.items():
            # They would give notice for five seconds, one after the other.
            self.processes.start(name, *server.command(
                "revisitd", *server.service["command"]),
                stop_signal=signal.SIGKILL)
        self.envoy = self._start("envoy", ENVOY, BIN / "revisit")
        self.prometheus = self._start("prometheus", PROMETHEUS)
        self.console = Container(self, "console", [CONSOLE],
                                 image_environment("Containerfile.console"))
        self.processes.start("console", *self.console.command(
            "node", f"/opt/{CONSOLE.name}/server/main.js"))

    def _start(self, name, *programs):
        """A service whose image's entry point takes the name of its program."""
        container = Container(self, name, programs)
        command = container.service["command"]
        if command[0] != programs[0].name:
            command = [programs[0].name, *command]
        self.processes.start(name, *container.command(*command))
        return container

    def _start_database(self):
        """As its image does: trusts everybody, and runs what is mounted."""
        service = self.services["database"]
        assert service["environment"] == {"POSTGRES_HOST_AUTH_METHOD": "trust"}
        [script] = [volume.split(":")[0] for volume in service["volumes"]
                    if ":/docker-entrypoint-initdb.d/" in volume]
        launch = [*self.network.join("database", self.addresses["database"]),
                  "setpriv", "--reuid=postgres", "--regid=postgres",
                  "--init-groups"]
        data = self.directory / "database"
        data.mkdir(mode=0o700)
        shutil.chown(data, "postgres")
        programs = find_postgres()
        do(*launch, programs / "initdb", "--username=postgres", "--auth=trust",
           f"--pgdata={data}", cwd="/")
        with open(data / "pg_hba.conf", "a") as file:
            file.write("host all all all trust\n")
        process = self.processes.start(
            "postgres", *launch, programs / "postgres", "-D", data, "-c",
            "listen_addresses=*", "-c", f"unix_socket_directories={data}", cwd="/",
            # Ends its sessions rather than waits for them.
            stop_signal=signal.SIGINT)
        wait_until(lambda: subprocess.run(
            [*launch, programs / "pg_isready", "--quiet", "--host", data], cwd="/",
            check=False).returncode == 0, "PostgreSQL", process)
        do(*launch, programs / "psql", "--host", data, "--username=postgres",
           "--file=-", cwd="/", input=pathlib.Path(script).read_text())

    def is_healthy(self, name):
        """By the health check of the file."""
        kind, *command = self.services[name]["healthcheck"]["test"]
        assert kind == "CMD"
        command[0] = pathlib.Path(command[0]).name
        return subprocess.run(
            [*map(str, self.servers[name].command(*command))],
            capture_output=True, check=False).returncode == 0

    def log(self):
        return "\n".join(f"{path}:\n{path.read_text(errors='replace')[-2000:]}"
                         for path in sorted(self.directory.glob("*.log")))


def missing():
    """Why the services cannot be started here; None if they can."""
    if os.geteuid() != 0:
        return "only root may make networks"
    if find_postgres() is None:
        return "there is no PostgreSQL"
    for name, path in (("Envoy", ENVOY), ("Prometheus", PROMETHEUS)):
        if path is None or not os.access(path, os.X_OK):
            return f"there is no {name}: tests/run installs it"
    if shutil.which("node") is None or not CONSOLE.exists():
        return "there is no console: deploy/console --build-only makes it"
    if shutil.which("ip") is None:
        return "there is no program ip"
    tried = subprocess.run(
        ["unshare", "--net", "--mount", "ip", "link", "add", "one", "type", "veth",
         "peer", "name", "other"], capture_output=True, text=True, check=False)
    return tried.stderr.strip() or None


@pytest.fixture(scope="module")
def compose():
    if problem := missing():
        pytest.skip(problem)
    # Users without rights have to get there.
    with tempfile.TemporaryDirectory(prefix="compose-") as name, \
            contextlib.ExitStack() as stack:
        directory = pathlib.Path(name)
        directory.chmod(0o755)
        tree = directory / "tree"
        shutil.copytree(ROOT / "deploy", tree / "deploy",
                        ignore=shutil.ignore_patterns("files"))
        do(tree / "deploy/compose/prepare")
        services = yaml.safe_load(do(
            "docker-compose", "--file", tree / "deploy/compose/compose.yaml",
            "config"))["services"]
        network = stack.enter_context(Network())
        processes = stack.enter_context(Processes(directory))
        started = Compose(services, network, processes)
        started.files = tree / "deploy/compose/files"
        try:
            started.start()
            for server in SERVERS:
                wait_until(lambda server=server: started.is_healthy(server),
                           f"health of {server}")
        except BaseException:
            print(started.log())
            raise
        yield started
        print(started.log())


@pytest.fixture(scope="module")
def revisit(compose):
    """Runs `revisit` beside Envoy, whose port is this machine's."""
    (compose.directory / "envoy/opt/drive.csv").write_bytes(DRIVE.read_bytes())
    (compose.directory / "envoy/opt/ca.pem").write_bytes(
        (compose.files / "servers-ca.pem").read_bytes())

    def command(*arguments):
        return [*map(str, compose.envoy.command(
            "revisit", "--server", "localhost:50051", "--tls-ca", "/opt/ca.pem",
            *arguments))]

    # Envoy looks at the health of the servers first.
    wait_until(lambda: subprocess.run(
        command("info"), capture_output=True, check=False).returncode == 0,
        "server behind Envoy")
    return lambda *arguments: do(*command(*arguments))


def test_services_see_the_processors_of_the_machine(compose):
    processors = pathlib.Path("/sys/devices/system/cpu/online")
    for service in (*compose.servers.values(), compose.envoy, compose.console):
        assert do(*service.command("cat", processors)) == processors.read_text()


def test_drive_is_streamed_through_envoy_and_its_loops_are_found(revisit):
    streamed = revisit("stream", "/opt/drive.csv", "--uncertainty", "file",
                       "--vehicle", "shuttle-7", "--create")
    shown = revisit("vehicle", "get", "shuttle-7")
    assert re.search(r"^durable poses +2076$", shown, re.MULTILINE), streamed
    found = revisit("find", "shuttle-7", "--direction", "either", "--exhaustive")
    assert " ACCEPTED" in found


def test_all_servers_share_the_database(revisit, compose):
    for number in range(12):
        revisit("vehicle", "create", f"truck-{number}")
        revisit("vehicle", "get", f"truck-{number}")
    info = json.loads(revisit("info", "--json"))
    text = json.dumps(info)
    for server in SERVERS:
        assert f"{compose.addresses[server]}:50051" in text, text


def test_console_shows_what_is_behind_envoy(revisit, compose):
    """Asked where its port would be published."""
    revisit("vehicle", "create", "looked-at")
    said = do(*compose.console.command(
        "python3", "-c", "import urllib.request as r; print(r.urlopen(r.Request("
        "'http://127.0.0.1:8080/revisit.v1.PoseGraphService/ListVehicles', b'{}', "
        "{'content-type': 'application/json'})).read().decode()); "
        "print(r.urlopen('http://127.0.0.1:8080/metrics.json').read().decode())"))
    vehicles, metrics = map(json.loads, said.strip().split("\n"))
    assert "vehicles/looked-at" in [one["name"] for one in vehicles["vehicles"]]
    assert [one["name"] for one in metrics["servers"]] == [
        f"{server}:9464" for server in SERVERS]


def test_prometheus_scrapes_every_server_by_its_name(compose):
    """Asks Prometheus as Grafana does."""

    def up():
        said = subprocess.run(
            [*map(str, compose.prometheus.command(
                "python3", "-c", "import urllib.request as r; print(r.urlopen("
                "'http://prometheus:9090/api/v1/query?query=up').read().decode())"))],
            capture_output=True, text=True, check=False)
        if said.returncode != 0:
            return None
        found = {result["metric"]["instance"]: result["value"][1]
                 for result in json.loads(said.stdout)["data"]["result"]}
        return found == {**{f"{server}:9464": "1" for server in SERVERS},
                         "console:9465": "1"}

    wait_until(up, "scrape of every server")
