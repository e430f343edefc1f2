"""A Debian 12 machine for one test, which systemd has booted."""

import contextlib
import os
import pathlib
import shutil
import signal
import subprocess
import tempfile
import time

import pytest

BASE = pathlib.Path(os.environ["REVISIT_BASE"])

BOOT_SECONDS = 120
COMMAND_SECONDS = 120


def wait_until(condition, what, seconds=COMMAND_SECONDS):
    """Waits for a condition that nothing announces; answers its value."""
    deadline = time.monotonic() + seconds
    while True:
        value = condition()
        if value:
            return value
        assert time.monotonic() < deadline, f"no {what} within {seconds} s"
        time.sleep(0.1)


class CannotBoot(Exception):
    """systemd does not come up here."""


class Machine:
    """A machine with a disk of its own above the base, and no network but its own
    loopback. Programs run in it as root."""

    def __init__(self):
        # Not below /tmp, which may itself be an overlay.
        self._files = pathlib.Path(tempfile.mkdtemp(dir=BASE.parent))
        self.root = self._files / "root"
        self._nspawn = None
        self._leader = None
        for name in ("root", "upper", "work"):
            (self._files / name).mkdir()
        try:
            self._mount()
            self._boot()
        except BaseException:
            self.close()
            raise

    def _mount(self):
        mounted = subprocess.run(
            ["mount", "-t", "overlay", "overlay", "-o",
             f"lowerdir={BASE},upperdir={self._files / 'upper'},"
             f"workdir={self._files / 'work'}", self.root],
            capture_output=True, text=True, check=False)
        if mounted.returncode != 0:
            raise CannotBoot(mounted.stderr)

    def _boot(self):
        with open(self._files / "console", "wb") as console:
            self._nspawn = subprocess.Popen(
                ["systemd-nspawn", "--quiet", "--boot", "--directory", self.root,
                 # There may be no systemd out here.
                 "--register=no", "--keep-unit", "--link-journal=no",
                 "--private-network", "--resolv-conf=off", "--timezone=off",
                 "--console=read-only"],
                stdin=subprocess.DEVNULL, stdout=console, stderr=console)
        children = pathlib.Path(
            f"/proc/{self._nspawn.pid}/task/{self._nspawn.pid}/children")
        deadline = time.monotonic() + BOOT_SECONDS
        while True:
            if self._nspawn.poll() is not None or time.monotonic() > deadline:
                raise CannotBoot((self._files / "console").read_text(
                    errors="replace")[-2000:])
            pids = children.read_text().split()
            if pids:
                self._leader = pids[0]
                state = self.run("systemctl", "is-system-running",
                                 check=False).strip()
                if state in ("running", "degraded"):
                    return
            time.sleep(0.2)

    def run(self, *command, check=True, seconds=COMMAND_SECONDS):
        """Runs a command that has to succeed; answers its output."""
        result = subprocess.run(
            ["nsenter", "--target", self._leader, "--all", "--", "env", "-i",
             "PATH=/usr/sbin:/usr/bin:/sbin:/bin", "LC_ALL=C.UTF-8",
             "HOME=/root", "DEBIAN_FRONTEND=noninteractive",
             *map(str, command)],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, timeout=seconds, check=False)
        if check:
            assert result.returncode == 0, (command, result.stdout)
        return result.stdout

    def install(self, *packages):
        """Installs packages, or what they upgrade, as an operator does."""
        for package in packages:
            shutil.copy(package, self.root / "root")
        return self.run(
            "apt-get", "install", "-y", "-o", "Dpkg::Options::=--force-confdef",
            "-o", "Dpkg::Options::=--force-confold",
            *(f"/root/{package.name}" for package in packages))

    def show(self, key, unit="revisitd"):
        """What systemd says of a service."""
        return self.run("systemctl", "show", "--property", key, "--value",
                        unit).strip()

    def journal(self, unit="revisitd"):
        return self.run("journalctl", "--unit", unit, "--output", "cat")

    def logged(self, text, unit="revisitd"):
        """Waits for a text in the journal, which is written beside the service."""
        wait_until(lambda: text in self.journal(unit),
                   f"{text!r} in the journal")

    def close(self):
        if self._nspawn is not None and self._nspawn.poll() is None:
            if self._leader is not None:
                # Systemd takes it for an order to power off.
                os.kill(int(self._leader), signal.SIGRTMIN + 4)
            try:
                self._nspawn.wait(30)
            except subprocess.TimeoutExpired:
                self._nspawn.kill()
                self._nspawn.wait()
        subprocess.run(["umount", self.root], check=False,
                       capture_output=True)
        if not self.root.is_mount():
            shutil.rmtree(self._files)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


@contextlib.contextmanager
def booted_machine():
    """A machine for a test, which is skipped where none can boot."""
    try:
        made = Machine()
    except CannotBoot as problem:
        pytest.skip(f"systemd cannot boot here: {problem}")
    with made:
        yield made
