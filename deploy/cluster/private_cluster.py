"""A cluster on this machine, for trying it: PostgreSQL, some revisitd, and Envoy with
the configuration beside this file. All listen on the loopback or at sockets of files,
all files lie in one directory, and all processes are stopped in the end."""

import contextlib
import http.client
import importlib.util
import json
import os
import pathlib
import pwd
import random
import re
import shutil
import signal
import socket
import subprocess
import time

HERE = pathlib.Path(__file__).resolve().parent
START_SECONDS = 30
STOP_SECONDS = 20
# Who may not be root, as whom PostgreSQL then runs.
UNPRIVILEGED = ("postgres", "nobody")


def find_envoy():
    """Envoy of the wheel that is installed with this Python; None without one."""
    package = importlib.util.find_spec("envoy")
    return package and pathlib.Path(package.origin).parent / "_bin/envoy"


def find_postgres():
    """The directory of the programs of the newest PostgreSQL that is installed; None
    without one."""
    found = sorted(pathlib.Path("/usr/lib/postgresql").glob("*/bin/initdb"),
                   key=lambda path: int(path.parts[-3]))
    return found[-1].parent if found else None


def _replace(path, text):
    fresh = path.with_name(path.name + ".new")
    fresh.write_text(text)
    fresh.rename(path)


def _replaced(text, replacements):
    for old, new in replacements.items():
        if old not in text:
            raise ValueError(f"there is no {old!r} to be replaced")
        text = text.replace(old, str(new))
    return text


def _wait_until(condition, what):
    deadline = time.monotonic() + START_SECONDS
    while not (value := condition()):
        if time.monotonic() > deadline:
            raise TimeoutError(f"no {what} within {START_SECONDS} s")
        time.sleep(0.02)
    return value


def _free_port():
    """A port below those that Linux gives to connections."""
    while True:
        port = random.randrange(20000, 32768)
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port


class Process:
    """A program in a session of its own, so that Ctrl-C at a terminal does not reach
    it, with its output in a file."""

    def __init__(self, name, directory, command, stop_signal, options):
        self.name = name
        self._log_path = directory / f"{name}.log"
        self._stop_signal = stop_signal
        with open(self._log_path, "wb") as log:
            self._process = subprocess.Popen(
                [*map(str, command)], stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                start_new_session=True, **options)

    @property
    def pid(self):
        return self._process.pid

    def is_running(self):
        return self._process.poll() is None

    def log(self):
        return self._log_path.read_text(errors="replace")

    def check(self):
        if not self.is_running():
            raise RuntimeError(f"{self.name} ended with {self._process.returncode}:\n"
                               + self.log()[-4000:])

    def kill(self):
        self._process.kill()
        self._process.wait()

    def stop(self):
        if not self.is_running():
            return
        self._process.send_signal(self._stop_signal)
        try:
            self._process.wait(STOP_SECONDS)
        except subprocess.TimeoutExpired:
            self.kill()


class Processes:
    """Programs that were started, with their files in one directory. A context manager
    that stops them, the last one first."""

    def __init__(self, directory):
        self.directory = directory
        self._started = []

    def start(self, name, *command, stop_signal=signal.SIGTERM, **options):
        process = Process(name, self.directory, command, stop_signal, options)
        self._started.append(process)
        return process

    def stop(self):
        while self._started:
            self._started.pop().stop()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        # Whoever is impatient would leave some of them.
        kept = {number: signal.signal(number, signal.SIG_IGN) for number in (
            signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
        self.stop()
        for number, handler in kept.items():
            signal.signal(number, handler)


class Postgres:
    """A database server of one's own, which only this machine's files lead to, unless
    it is told to listen at an address for the hosts of a network."""

    def __init__(self, processes, address="", network=None):
        self._as = {}
        if os.geteuid() == 0:
            # PostgreSQL refuses to run as root.
            user = next(user for user in UNPRIVILEGED if _user_exists(user))
            self._as = {"user": user, "extra_groups": []}
        self._directory = processes.directory / "postgres"
        self._directory.mkdir(mode=0o700)
        if self._as:
            shutil.chown(self._directory, self._as["user"])
        self._processes = processes
        self._address = address
        self._programs = programs = find_postgres()
        self._run(programs / "initdb", "--username=postgres", "--auth=trust",
                  "--encoding=UTF8", "--locale=C", f"--pgdata={self._directory}/data")
        if network is not None:
            with open(self._directory / "data/pg_hba.conf", "a") as file:
                file.write(f"host all all {network} trust\n")
        self.start()
        _wait_until(self._answers, "PostgreSQL")
        self._run(programs / "psql", "--host", self._directory, "--username=postgres",
                  "--no-psqlrc", "--file=-", input=(HERE / "database.sql").read_text())

    def start(self, *settings):
        """Also again, after it was stopped."""
        words = [word for setting in (
            f"listen_addresses={self._address}",
            f"unix_socket_directories={self.sockets}", "lc_messages=C", *settings)
            for word in ("-c", setting)]
        self.process = self._processes.start(
            "postgres", self._programs / "postgres", "-D", self._directory / "data",
            *words,
            # Ends its sessions rather than waits for them.
            stop_signal=signal.SIGINT, cwd=self._directory, **self._as)

    def stand_by(self, *settings):
        """Stops it and starts it as a standby that waits for a log that does not
        come."""
        self.process.stop()
        self._run("touch", self._directory / "data/standby.signal")
        self.start(*settings)

    def promote(self):
        data = self._directory / "data"
        # pg_ctl goes by this file, which says so some time after the start.
        _wait_until(lambda: "in archive recovery" in self._run(
            self._programs / "pg_controldata", "-D", data), "standby")
        self._run(self._programs / "pg_ctl", "promote", "-D", data)

    @property
    def sockets(self):
        """The directory of its sockets."""
        return self._directory

    def url(self, role, sockets=None):
        """For --store; by the sockets of what stands before it, if there are any."""
        return f"postgresql:///revisit?host={sockets or self.sockets}&user={role}"

    def ask(self, sql):
        """What psql prints, without blanks and headings."""
        return self._run(find_postgres() / "psql", "--host", self._directory,
                         "--username=postgres", "--no-psqlrc", "--no-align",
                         "--tuples-only", "--file=-", "revisit", input=sql).strip()

    def _run(self, *command, input=""):
        result = subprocess.run(
            [*map(str, command)], capture_output=True, text=True, check=False,
            input=input, cwd=self._directory, **self._as)
        if result.returncode != 0:
            raise RuntimeError(f"{command[0]}: {result.stderr}{result.stdout}")
        return result.stdout

    def _answers(self):
        self.process.check()
        return subprocess.run(
            [self._programs / "pg_isready", "--quiet", "--host", self._directory],
            check=False, cwd=self._directory).returncode == 0


def _user_exists(user):
    try:
        pwd.getpwnam(user)
        return True
    except KeyError:
        return False


class Server:
    """One revisitd."""

    def __init__(self, processes, name, binaries, store, *flags):
        # The others of a shared store call it by this address.
        self.address = f"127.0.0.1:{_free_port()}"
        port_file = processes.directory / f"{name}.address"
        self.process = processes.start(
            name, binaries / "revisitd", "--store", store, "--listen", self.address,
            "--port-file", port_file, *flags, env=_environment())

        def listens():
            self.process.check()
            return port_file.exists()

        _wait_until(listens, name)


def _environment():
    """Without settings of revisitd."""
    return {name: value for name, value in os.environ.items()
            if not name.startswith("REVISIT_")}


class Envoy:
    """Envoy in front of servers at these addresses of the loopback, with certificates
    that lie in the directory already. `before` is a filter that comes before all
    others."""

    def __init__(self, processes, program, addresses, before=""):
        self._directory = processes.directory
        self.list_servers(addresses)
        port = _free_port()
        self.address = f"127.0.0.1:{port}"
        configuration = self._directory / "envoy.yaml"
        first = "          - name: envoy.filters.http.grpc_field_extraction\n"
        configuration.write_text(_replaced((HERE / "envoy.yaml").read_text(), {
            "/etc/revisit": self._directory, "/run/revisit": self._directory,
            "address: 0.0.0.0, port_value: 50051":
                f"address: 127.0.0.1, port_value: {port}",
            first: before + first}))
        self.process = processes.start(
            "envoy", program, "-c", configuration, "--disable-hot-restart",
            "--concurrency", "2", "--log-level", "warning")
        _wait_until(lambda: self.healthy() == len(addresses), "healthy servers")

    def list_servers(self, addresses):
        """Divides vehicles among these from now on."""
        head, line, _ = re.split(r"(    - endpoint: .*\n)",
                                 (HERE / "servers.yaml").read_text(), maxsplit=1)
        lines = []
        for address in addresses:
            host, port = address.split(":")
            lines.append(_replaced(line, {"10.0.0.11": host, "50051": port}))
        _replace(self._directory / "servers.yaml", head + "".join(lines))

    def hosts(self):
        """What Envoy says about each server."""
        connection = http.client.HTTPConnection("envoy")
        connection.sock = socket.socket(socket.AF_UNIX)
        try:
            connection.sock.connect(str(self._directory / "envoy.sock"))
            connection.request("GET", "/clusters?format=json")
            status = json.load(connection.getresponse())
        except OSError:
            self.process.check()
            return []
        finally:
            connection.close()
        return [host for cluster in status["cluster_statuses"]
                for host in cluster.get("host_statuses", ())]

    def healthy(self):
        """How many servers Envoy takes for healthy."""
        return sum(host["health_status"] == {"eds_health_status": "HEALTHY"}
                   for host in self.hosts())

    def calls(self):
        """By address of a server, the calls that it has now."""
        calls = {}
        for host in self.hosts():
            place = host["address"]["socket_address"]
            active = [int(stat.get("value", 0)) for stat in host["stats"]
                      if stat["name"] == "rq_active"]
            calls[f"{place['address']}:{place['port_value']}"] = active[0]
        return calls


def _make_certificates(directory):
    """An authority, and certificates of Envoy's both sides and of the servers."""

    def openssl(*arguments):
        result = subprocess.run(["openssl", *map(str, arguments)], check=False,
                                capture_output=True, text=True, cwd=directory)
        if result.returncode != 0:
            raise RuntimeError(f"openssl: {result.stderr}")

    key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-noenc")
    openssl("req", "-x509", *key, "-keyout", "ca.key", "-out", "servers-ca.pem",
            "-days", "2", "-subj", "/CN=revisit demo")
    for name, alternatives in (("edge", "DNS:localhost,IP:127.0.0.1"),
                               ("server", "DNS:revisitd"), ("envoy", "DNS:envoy")):
        extensions = directory / f"{name}.extensions"
        extensions.write_text(f"subjectAltName={alternatives}\n")
        openssl("req", *key, "-keyout", f"{name}.key", "-out", f"{name}.request",
                "-subj", f"/CN={name}")
        openssl("x509", "-req", "-in", f"{name}.request", "-CA", "servers-ca.pem",
                "-CAkey", "ca.key", "-CAcreateserial", "-days", "2",
                "-extfile", extensions, "-out", f"{name}.pem")


# Whoever Envoy lets through may do everything.
POLICY = {"version": 1, "tenants": [], "grants": [
    {"certificate_dns": "envoy", "tenant": "*", "vehicles": ["*"],
     "verbs": ["read", "write", "admin"]}]}


class PrivateCluster:
    """Everything together. `processes` stops it."""

    def __init__(self, processes, binaries, servers, envoy):
        """`envoy` is the program."""
        directory = processes.directory
        self._processes, self._binaries = processes, binaries
        self.authorities = directory / "servers-ca.pem"
        _make_certificates(directory)
        policy = directory / "policy.json"
        policy.write_text(json.dumps(POLICY))
        self.postgres = Postgres(processes)
        self.run_task("migrate", "revisit_owner")
        self.servers = [
            Server(processes, f"revisitd-{number}", binaries,
                   self.postgres.url("revisit"), "--tls-cert", directory / "server.pem",
                   "--tls-key", directory / "server.key",
                   "--tls-client-ca", self.authorities, "--policy", policy)
            for number in range(1, servers + 1)]
        self.envoy = Envoy(processes, envoy,
                           [server.address for server in self.servers])

    def run_task(self, task, role):
        """Runs a task of revisitd on the database; its output. RuntimeError if it
        fails."""
        result = subprocess.run(
            [self._binaries / "revisitd", task, "--store", self.postgres.url(role)],
            capture_output=True, text=True, check=False, env=_environment(),
            stdin=subprocess.DEVNULL)
        if result.returncode != 0:
            raise RuntimeError(f"revisitd {task}: {result.stderr}{result.stdout}")
        return result.stdout

    def start_alone(self):
        """A server with a SQLite file of its own, without TLS."""
        return Server(self._processes, "alone", self._binaries,
                      self._processes.directory / "store")
