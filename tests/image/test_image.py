"""The container images, started as an orchestrator starts them: as their user, without
rights, with a read-only root."""

import contextlib
import json
import os
import pathlib
import re
import signal
import subprocess
import time

import pytest

FILES = pathlib.Path(os.environ["REVISIT_IMAGE_FILES"])
ROOT = pathlib.Path(os.environ["REVISIT_IMAGE_ROOT"])
CONSOLE_ROOT = pathlib.Path(os.environ["REVISIT_CONSOLE_ROOT"])
DRIVE = "/usr/share/revisit/demo/boreas_glen_shields.csv"

START_SECONDS = 30


def said_by(image):
    """What an image says of itself."""
    inspected = json.loads((FILES / f"{image}.json").read_text())
    return inspected["Docker"]["config"]


@pytest.fixture(scope="module")
def config():
    return said_by("revisit")


@pytest.fixture(scope="module")
def console_config():
    return said_by("revisit-console")


class Container:
    """An image's program in a container with no network but its own loopback."""

    def __init__(self, config, root, directory, program, greeting, variables,
                 options=()):
        """`program` says its `greeting` once it serves; its log goes to
        `directory`."""
        self.user, self.group = config["User"].split(":")
        self.environment = {
            **dict(entry.split("=", 1) for entry in config["Env"]), **variables}
        self.log = directory / "log"
        with open(self.log, "wb") as log:
            self.process = subprocess.Popen(
                ["systemd-nspawn", "--quiet", "--register=no", "--keep-unit",
                 "--directory", root, "--read-only", "--tmpfs=/tmp", *options,
                 "--private-network",
                 "--resolv-conf=off", "--timezone=off", "--link-journal=no",
                 "--as-pid2", "--console=pipe",
                 *(f"--setenv={name}={value}"
                   for name, value in self.environment.items()),
                 # --user of systemd-nspawn makes a home on the read-only disk.
                 "/usr/bin/setpriv", f"--reuid={self.user}",
                 f"--regid={self.group}", "--clear-groups", "--inh-caps=-all",
                 "--bounding-set=-all", "--no-new-privs",
                 *config["Entrypoint"]],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        deadline = time.monotonic() + START_SECONDS
        while greeting not in self.text():
            assert self.process.poll() is None, self.text()
            assert time.monotonic() < deadline, self.text()
            time.sleep(0.05)
        [self.pid] = [int(line) for line in subprocess.run(
            ["pgrep", "--uid", self.user, "--exact", program],
            capture_output=True, text=True, check=True).stdout.split()]

    def text(self):
        return self.log.read_text(errors="replace")

    def run(self, *command):
        """Runs a program of the image as its user."""
        return subprocess.run(
            ["nsenter", "--target", str(self.pid), "--mount", "--uts", "--ipc",
             "--net", "--pid", "--setuid", self.user, "--setgid", self.group,
             "--", "env", "-i", *(f"{name}={value}" for name, value
                                  in self.environment.items()),
             *map(str, command)],
            capture_output=True, text=True, timeout=60, check=False)

    def stop(self):
        """As an orchestrator does; answers how the program ended."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGTERM)
        return self.process.wait(30)


def start_server(config, directory):
    """A server with a volume for its store."""
    volume = directory / "store"
    volume.mkdir(exist_ok=True)
    os.chown(volume, *map(int, config["User"].split(":")))
    return Container(
        config, ROOT, directory, "revisitd", "listening on",
        # Nobody else reaches its loopback.
        {"REVISIT_INSECURE_ALLOW_REMOTE": "on"},
        [f"--bind={volume}:/var/lib/revisit"])


@pytest.fixture
def container(config, tmp_path):
    made = start_server(config, tmp_path)
    yield made
    made.stop()


@pytest.fixture
def console(console_config, tmp_path):
    made = Container(
        console_config, CONSOLE_ROOT, tmp_path, "node", "The console is at",
        {"REVISIT_CONSOLE_INSECURE_ALLOW_REMOTE": "on"})
    yield made
    made.stop()


def test_image_names_a_user_by_number_who_is_not_root(config):
    assert re.fullmatch(r"[1-9]\d{3,}:[1-9]\d{3,}", config["User"])
    assert list(config["Volumes"]) == ["/var/lib/revisit"]
    assert list(config["ExposedPorts"]) == ["50051/tcp"]


def test_container_keeps_poses_over_a_restart(config, tmp_path):
    first = start_server(config, tmp_path)
    streamed = first.run("/usr/bin/revisit", "stream", DRIVE, "--uncertainty",
                         "file", "--vehicle", "shuttle-7", "--create")
    assert streamed.returncode == 0, streamed.stderr
    assert first.stop() == 0
    assert '"event":"stopped"' in first.text()

    second = start_server(config, tmp_path)
    found = second.run("/usr/bin/revisit", "vehicle", "get", "shuttle-7")
    assert second.stop() == 0
    assert re.search(r"^durable poses +2076$", found.stdout, re.MULTILINE)


def test_program_in_the_container_has_no_rights_and_no_disk_but_its_store(
        container):
    status = pathlib.Path(f"/proc/{container.pid}/status").read_text()
    fields = dict(re.findall(r"^(\w+):\s+(.*)$", status, re.MULTILINE))
    assert fields["Uid"].split() == [container.user] * 4
    assert fields["CapEff"] == fields["CapBnd"] == 16 * "0"
    refused = container.run("/usr/bin/touch", "/usr/bin/something", "/etc/else")
    assert refused.stderr.count("Read-only file system") == 2
    assert container.run("/usr/bin/touch", "/var/lib/revisit/x").returncode == 0


def test_health_check_of_the_image_follows_the_server(config, container):
    check = config["Healthcheck"]["Test"]
    assert check[0] == "CMD"
    healthy = container.run(*check[1:])
    assert (healthy.returncode, healthy.stdout) == (0, "SERVING\n")
    os.kill(container.pid, signal.SIGSTOP)
    try:
        assert container.run(*check[1:], "--timeout", "1").returncode != 0
    finally:
        os.kill(container.pid, signal.SIGCONT)


def test_image_holds_nothing_to_build_with():
    for program in ("c++", "cmake", "ccache", "protoc", "git"):
        assert not (ROOT / "usr/bin" / program).exists(), program
    assert not (ROOT / "src").exists()
    assert not list((ROOT / "tmp").iterdir())


def test_console_serves_its_pages_without_rights_and_without_a_disk(
        console_config, console):
    assert re.fullmatch(r"[1-9]\d{3,}:[1-9]\d{3,}", console_config["User"])
    assert list(console_config["ExposedPorts"]) == ["8080/tcp"]
    status = pathlib.Path(f"/proc/{console.pid}/status").read_text()
    fields = dict(re.findall(r"^(\w+):\s+(.*)$", status, re.MULTILINE))
    assert fields["Uid"].split() == [console.user] * 4
    assert fields["CapEff"] == fields["CapBnd"] == 16 * "0"
    asked = console.run("/usr/bin/node", "--input-type=module", "--eval", """
        const get = async url => {
          const answer = await fetch(url);
          return [answer.status, await answer.text()];
        };
        console.log(JSON.stringify([await get('http://127.0.0.1:8080/'),
                                    await get('http://127.0.0.1:9465/readyz')]));
        """)
    assert asked.returncode == 0, asked.stderr
    [status, page], [ready, why] = json.loads(asked.stdout)
    assert status == 200 and "<title>" in page
    # There is no server in its container.
    assert ready == 503 and "no revisitd" in why
    assert '"event":"server_away"' in console.text()


def test_health_check_of_the_console_follows_it(console_config, console):
    check = console_config["Healthcheck"]["Test"]
    assert check[0] == "CMD"
    healthy = console.run(*check[1:])
    assert healthy.returncode == 0, healthy.stderr
    assert console.stop() == 0
    assert '"event":"stopping"' in console.text()


def test_image_of_the_console_holds_nothing_to_build_with():
    for program in ("npm", "c++", "protoc", "git"):
        assert not (CONSOLE_ROOT / "usr/bin" / program).exists(), program
    assert not (CONSOLE_ROOT / "src").exists()
    assert not list(CONSOLE_ROOT.glob("usr/share/revisit/**/node_modules"))


def test_bill_of_materials_has_every_package_of_the_image():
    bill = json.loads((FILES / "sbom.spdx.json").read_text())
    assert bill["spdxVersion"] == "SPDX-2.3"
    packages = {package["name"]: package for package in bill["packages"]
                if package.get("primaryPackagePurpose") == "LIBRARY"}
    listed = subprocess.run(
        ["dpkg-query", f"--admindir={ROOT}/var/lib/dpkg", "--show",
         "--showformat=${Package} ${Version}\\n"],
        capture_output=True, text=True, check=True).stdout.split("\n")
    installed = dict(line.split() for line in listed if line)
    assert {name: package["versionInfo"]
            for name, package in packages.items()} == installed
    assert {"revisit", "revisit-server", "libgrpc++1.51"} <= set(installed)
