"""The image for arm64, made of the packages for it: it starts there as its user."""

import json
import os
import pathlib
import re
import subprocess
import time

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]
BARE = pathlib.Path(os.environ["REVISIT_ARM64_BARE"])
WORK = ROOT / "build/arm64/image"
BUILDAH = ["buildah", "--root", WORK / "storage", "--runroot", WORK / "run",
           "--storage-driver", "overlay"]
#: Seconds that nothing here takes, on however busy a machine.
LONG = 1800

pytestmark = pytest.mark.skipif(not os.environ["REVISIT_ARM64_ALL"],
                                reason="tests/arm64/run --all has it")


def do(*command):
    """Runs a command that has to succeed; answers its output."""
    result = subprocess.run(list(map(str, command)), capture_output=True, text=True,
                            timeout=LONG, check=False)
    assert result.returncode == 0, (result.stdout + result.stderr)[-4000:]
    return result.stdout


def buildah(*command):
    return do(*BUILDAH, *command).strip()


@pytest.fixture(scope="module")
def image():
    """What the image says of itself, and where it is mounted."""
    WORK.mkdir(parents=True, exist_ok=True)
    base = buildah("from", "--arch", "arm64", "scratch")
    buildah("add", "--quiet", base, BARE / "base", "/")
    buildah("commit", "--quiet", "--rm", base, "localhost/debian:arm64")
    # The format of OCI has no health check.
    buildah("build", "--isolation", "chroot", "--pull-never", "--format", "docker",
            "--platform", "linux/arm64",
            "--build-context", f"packages={ROOT / 'build/arm64/release/packages'}",
            "--build-arg", "BASE=localhost/debian:arm64",
            "--file", ROOT / "deploy/image/Containerfile", "--tag", "localhost/revisit",
            ROOT)
    container = buildah("from", "--pull-never", "--arch", "arm64", "localhost/revisit")
    mounted = buildah("mount", container)
    inspected = json.loads(buildah("inspect", "--type", "image", "localhost/revisit"))
    yield inspected["Docker"], pathlib.Path(mounted)
    buildah("umount", container)
    buildah("rm", container)


def test_the_image_is_of_arm64(image):
    said, _ = image
    assert said["architecture"] == "arm64"


def test_its_server_serves_as_its_user_and_its_health_check_agrees(image):
    said, root = image
    user, group = said["config"]["User"].split(":")
    store = root / "var/lib/revisit"
    assert (store.stat().st_uid, store.stat().st_gid) == (int(user), int(group))
    inside = ["chroot", root, "setpriv", f"--reuid={user}", f"--regid={group}",
              "--clear-groups", "--no-new-privs", "env", "-i", *said["config"]["Env"],
              # Of this machine, whose network it has.
              "REVISIT_LISTEN=127.0.0.1:0", "REVISIT_STORE=/var/lib/revisit"]
    log = WORK / "log"
    with open(log, "wb") as output:
        server = subprocess.Popen([*map(str, inside), *said["config"]["Entrypoint"]],
                                  stdout=output, stderr=output)
    try:
        deadline = time.monotonic() + LONG
        address = re.compile(r'"address":"127\.0\.0\.1:(\d+)"')
        while not (port := address.search(log.read_text())):
            assert server.poll() is None, log.read_text()
            assert time.monotonic() < deadline, log.read_text()
            time.sleep(0.1)
        check = said["config"]["Healthcheck"]["Test"][1:]
        assert "SERVING" in do(*inside, f"REVISIT_SERVER=127.0.0.1:{port[1]}", *check)
    finally:
        server.terminate()
        server.wait()
