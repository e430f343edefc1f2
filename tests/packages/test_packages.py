"""The Debian packages: what is in them, and their life on a Debian 12 machine."""

import lzma
import os
import pathlib
import re
import resource
import subprocess

import pytest

from machine import booted_machine, wait_until

ROOT = pathlib.Path(__file__).resolve().parents[2]
PACKAGES = pathlib.Path(os.environ["REVISIT_PACKAGES"])
UNITS = [ROOT / "deploy/packages" / name
         for name in ("revisitd.service", "revisit-console.service")]
DRIVE = "/usr/share/revisit/demo/boreas_glen_shields.csv"
STORE = "/var/lib/revisit"
SETTINGS = "/etc/revisit/revisitd.conf"
CONSOLE = "revisit-console"
CONSOLE_SETTINGS = "/etc/revisit/console.conf"


def package(name):
    [path] = PACKAGES.glob(f"{name}_*.deb")
    return path


BOTH = ("revisit", "revisit-server")


@pytest.fixture
def machine():
    with booted_machine() as made:
        yield made


def installed(machine):
    """The machine, with client and server installed."""
    machine.install(*map(package, BOTH))
    return machine


def with_console(machine, **settings):
    """The machine with all three, and these settings of the console besides."""
    machine.install(*map(package, (*BOTH, CONSOLE)))
    with open(machine.root / CONSOLE_SETTINGS[1:], "a") as file:
        for name, value in settings.items():
            file.write(f'{name.replace("_", "-")} = "{value}"\n')
    machine.run("systemctl", "restart", CONSOLE, check=False)
    return machine


def fetched(machine, path, port=8080, body=None):
    """Status and text of what the console answers in the machine."""
    options = ("{}" if body is None else
               "{method: 'POST', headers: {'content-type': 'application/json'}, "
               f"body: '{body}'}}")
    status, text = machine.run("node", "--input-type=module", "--eval", f"""
        const answer = await fetch('http://127.0.0.1:{port}{path}', {options})
            .catch(() => ({{status: 0, text: () => ''}}));
        console.log(answer.status + ' ' + await answer.text());
        """).split(" ", 1)
    return int(status), text


def stream(machine):
    return machine.run("revisit", "stream", DRIVE, "--uncertainty", "file",
                       "--vehicle", "shuttle-7", "--create")


def durable(machine):
    shown = machine.run("revisit", "vehicle", "get", "shuttle-7")
    return int(re.search(r"^durable poses +(\d+)$", shown,
                         re.MULTILINE).group(1))


# ---- What is in them

def test_lintian_has_no_error_and_no_warning():
    said = subprocess.run(
        ["lintian", "--allow-root", "--fail-on", "error,warning",
         *PACKAGES.glob("*.deb")], capture_output=True, text=True, check=False)
    assert (said.returncode, said.stdout) == (0, "")


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_service_exposes_little_of_the_system(unit):
    said = subprocess.run(
        ["systemd-analyze", "security", "--no-pager", "--offline=true",
         # Tenths, of 0 to 10.
         "--threshold=12", unit], capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stdout + said.stderr
    print(said.stdout.splitlines()[-1])


def test_program_is_built_against_the_library_of_the_package(tmp_path):
    subprocess.run(["dpkg-deb", "-x", package("librevisit-dev"), tmp_path],
                   check=True)
    for command in (["-S", ROOT / "tests/install", "-B", tmp_path / "build",
                     f"-DCMAKE_PREFIX_PATH={tmp_path}/usr",
                     "-DCMAKE_BUILD_TYPE=Debug"],
                    ["--build", tmp_path / "build"]):
        made = subprocess.run(["cmake", *command], capture_output=True,
                              text=True, check=False)
        assert made.returncode == 0, made.stdout + made.stderr
    assert (tmp_path / "build/example").exists()


# ---- Their life

def test_service_starts_once_it_is_installed_and_keeps_poses(machine):
    installed(machine)
    assert machine.show("ActiveState") == "active"
    assert machine.show("Type") == "notify"
    assert machine.run("systemctl", "is-enabled", "revisitd") == "enabled\n"
    assert machine.run("systemd-analyze", "verify", "--man=no",
                       "revisitd.service") == ""
    stream(machine)
    machine.run("systemctl", "restart", "revisitd")
    assert durable(machine) == 2076
    machine.logged("stopped")
    machine.run("systemctl", "reload", "revisitd")
    machine.logged("looking_at_files")


def test_service_runs_without_rights_and_shuts_its_store_to_others(machine):
    installed(machine)
    pid = machine.show("MainPID")
    status = machine.run("cat", f"/proc/{pid}/status")
    fields = dict(re.findall(r"^(\w+):\s+(.*)$", status, re.MULTILINE))
    user = machine.run("id", "--user", "revisit").strip()
    assert user != "0"
    assert fields["Uid"].split() == [user] * 4
    assert {fields[name] for name in ("CapEff", "CapPrm", "CapBnd")} == {
        16 * "0"}
    assert fields["NoNewPrivs"] == "1"
    # Filtered system calls.
    assert fields["Seccomp"] == "2"
    assert machine.run("stat", "--format", "%U %a", STORE) == "revisit 700\n"
    # A machine in this one cannot give more than it was given.
    most = str(min(1 << 20, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
    assert machine.run("grep", "open files", f"/proc/{pid}/limits").split()[3:5] \
        == [most, most]


def test_service_that_hangs_is_restarted_with_all_that_was_acknowledged(machine):
    installed(machine)
    machine.run("mkdir", "/etc/systemd/system/revisitd.service.d")
    (machine.root / "etc/systemd/system/revisitd.service.d/soon.conf").write_text(
        "[Service]\nWatchdogSec=3s\n")
    machine.run("systemctl", "daemon-reload")
    machine.run("systemctl", "restart", "revisitd")
    stream(machine)
    pid = machine.show("MainPID")
    # Longer than the watchdog waits.
    machine.run("sleep", "5")
    assert machine.show("MainPID") == pid
    machine.run("kill", "-STOP", pid)
    wait_until(lambda: machine.show("NRestarts") == "1"
               and machine.show("ActiveState") == "active", "restart")
    machine.logged("Watchdog timeout")
    assert durable(machine) == 2076


def test_service_with_wrong_settings_is_not_started_again_and_again(machine):
    installed(machine)
    with open(machine.root / SETTINGS[1:], "a") as settings:
        settings.write('max-streems = "1"\n')
    machine.run("systemctl", "restart", "revisitd", check=False)
    assert machine.show("ActiveState") == "failed"
    assert machine.show("ExecMainStatus") == "64"
    assert machine.show("NRestarts") == "0"
    machine.logged(f"{SETTINGS}:")


# ---- The console

def test_console_shows_the_server_on_its_machine(machine):
    with_console(machine, admin_listen="127.0.0.1:9465")
    wait_until(lambda: fetched(machine, "/readyz", 9465) == (200, "ok\n\n"),
               "readiness")
    assert machine.run("systemctl", "is-enabled", CONSOLE) == "enabled\n"
    assert machine.run("systemd-analyze", "verify", "--man=no",
                       f"{CONSOLE}.service") == ""
    status, page = fetched(machine, "/")
    assert status == 200 and "<title>" in page
    machine.run("revisit", "vehicle", "create", "shuttle-7")
    status, listed = fetched(
        machine, "/revisit.v1.PoseGraphService/ListVehicles", body="{}")
    assert status == 200 and "vehicles/shuttle-7" in listed
    machine.logged("method=ListVehicles", CONSOLE)
    machine.run("systemctl", "stop", "revisitd")
    wait_until(lambda: fetched(machine, "/readyz", 9465)[0] == 503,
               "end of readiness")
    assert "revisit_console_server_up" in fetched(machine, "/metrics", 9465)[1]
    assert machine.run("revisit-console", "--version").startswith(
        "revisit-console ")


def test_console_runs_without_rights(machine):
    with_console(machine)
    assert machine.show("ActiveState", CONSOLE) == "active"
    pid = machine.show("MainPID", CONSOLE)
    status = machine.run("cat", f"/proc/{pid}/status")
    fields = dict(re.findall(r"^(\w+):\s+(.*)$", status, re.MULTILINE))
    user = machine.run("id", "--user", CONSOLE).strip()
    assert user != "0" and fields["Uid"].split() == [user] * 4
    assert {fields[name] for name in ("CapEff", "CapPrm", "CapBnd")} == {
        16 * "0"}
    assert (fields["NoNewPrivs"], fields["Seccomp"]) == ("1", "2")


def test_console_with_wrong_settings_is_not_started_again_and_again(machine):
    with_console(machine, colour="red")
    wait_until(lambda: machine.show("ActiveState", CONSOLE) == "failed", "failure")
    assert machine.show("ExecMainStatus", CONSOLE) == "64"
    assert machine.show("NRestarts", CONSOLE) == "0"
    machine.logged(f"{CONSOLE_SETTINGS}:", CONSOLE)


def test_console_tells_people_that_their_issuer_is_away(machine):
    """With the packages that it uses for it, on the Node.js of the machine."""
    with_console(machine, oidc_issuer="http://127.0.0.1:9", oidc_client_id="a")
    wait_until(lambda: fetched(machine, "/console.json")[0] == 200, "console")
    status, page = fetched(machine, "/sign-in")
    assert status == 400 and "Not signed in" in page
    # Fetch names no port that browsers block.
    assert "bad port" in page or "ECONNREFUSED" in page, page


def test_console_leaves_nothing_when_it_is_purged(machine):
    with_console(machine)
    machine.run("apt-get", "purge", "-y", CONSOLE)
    left = machine.run("find", "/etc", "/lib/systemd", "/usr", "/var/lib",
                       "-name", "*console*", "-path", "*revisit*", "-not",
                       "-path", "/var/lib/apt/*")
    assert left == ""
    assert machine.show("ActiveState") == "active"


# ---- Upgrade, removal

def earlier(name, directory):
    """The package as an earlier version, with other settings, would be."""
    tree = directory / name
    subprocess.run(["dpkg-deb", "-R", package(name), tree], check=True)
    control = tree / "DEBIAN/control"
    control.write_text(re.sub(r"^Version: .*$", "Version: 0.0.9-1",
                              control.read_text(), flags=re.MULTILINE))
    settings = tree / SETTINGS[1:]
    if settings.exists():
        settings.write_text("# As they once were.\n" + settings.read_text())
    made = directory / f"{name}_0.0.9-1.deb"
    subprocess.run(["dpkg-deb", "-b", "--root-owner-group", tree, made],
                   check=True, capture_output=True)
    return made


def test_upgrade_brings_a_store_of_the_release_before_along(machine, tmp_path):
    machine.install(*(earlier(name, tmp_path) for name in BOTH))
    assert machine.show("ActiveState") == "active"
    machine.run("systemctl", "stop", "revisitd")
    machine.run("find", STORE, "-mindepth", "1", "-delete")
    store = machine.root / STORE[1:] / "revisit.sqlite"
    store.write_bytes(lzma.decompress(
        (ROOT / "tests/data/stores/0.1.0.sqlite.xz").read_bytes()))
    machine.run("chown", "revisit:revisit", f"{STORE}/revisit.sqlite")
    with open(machine.root / SETTINGS[1:], "a") as settings:
        settings.write('log-format = "json"\n')
    mine = (machine.root / SETTINGS[1:]).read_text()

    installed(machine)
    assert machine.show("ActiveState") == "active", machine.journal()
    # Its settings stay, and those of the package lie beside them.
    assert (machine.root / SETTINGS[1:]).read_text() == mine
    assert (machine.root / f"{SETTINGS[1:]}.dpkg-dist").exists()
    machine.logged('"event":"serving"')
    # All poses are there: the drive goes on behind them, after the last of them
    # have been compared with it.
    assert durable(machine) == 2076
    again = stream(machine)
    assert re.search(r"^already durable +2076$", again, re.MULTILINE)
    assert "2068" in machine.run("revisit", "closures", "list", "shuttle-7")
    assert "1156" in machine.run("revisit", "rejections", "list", "shuttle-7")
    machine.run("systemctl", "stop", "revisitd")
    assert machine.run("revisitd", "verify", "--store", STORE).endswith(
        "sound\n")


def test_removal_keeps_store_and_settings_and_purging_deletes_them(machine):
    installed(machine)
    stream(machine)
    machine.run("apt-get", "remove", "-y", "revisit-server")
    machine.run("test", "-f", f"{STORE}/revisit.sqlite")
    machine.run("test", "-f", SETTINGS)
    assert machine.run("pgrep", "--exact", "revisitd", check=False) == ""

    machine.install(package("revisit-server"))
    assert machine.show("ActiveState") == "active"
    assert durable(machine) == 2076

    machine.run("apt-get", "purge", "-y", "revisit-server", "revisit")
    left = machine.run("find", "/etc", "/lib/systemd", "/usr", "/var/lib",
                       "-name", "*revisit*", "-not", "-path",
                       "/var/lib/apt/*")
    assert left == ""
    assert machine.run("systemctl", "--failed", "--no-legend") == ""


def test_demo_runs_from_the_packages_within_half_a_minute(machine):
    installed(machine)
    assert machine.run("sh", "-c", "command -v c++ cmake", check=False) == ""
    shown = machine.run("sh", "-c", "cd /tmp && revisit demo", seconds=30)
    recall = re.search(r"^recall +([0-9.]+)", shown, re.MULTILINE)
    assert recall and float(recall[1]) >= 0.9, shown[-2000:]
    assert machine.run("head", "-c", "4", "/tmp/demo.svg") == "<svg"
