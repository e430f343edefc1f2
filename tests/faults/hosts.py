"""Hosts of a network that can be cut: network namespaces, joined by one more that
forwards between them.

The fault matrix enters namespaces of its own first (`enter()`), so that its
network, mounts and processes are nobody else's, and gone when it is.
"""

import os
import pathlib
import subprocess
import sys

from skipped import Skipped

_ENTERED = "REVISIT_TEST_HAS_NAMESPACES"


def run(*command):
    """The output of a command that has to succeed."""
    result = subprocess.run([str(word) for word in command], text=True,
                            capture_output=True, check=False)
    assert result.returncode == 0, (command, result.stderr)
    return result.stdout


def enter():
    """Runs this program anew in namespaces of its own, if that is permitted."""
    if _ENTERED in os.environ:
        if os.environ[_ENTERED] == "yes":
            run("ip", "link", "set", "lo", "up")
        return
    words = ["unshare", "--net", "--mount", "--propagation", "private", "--pid",
             "--fork", "--kill-child", "--mount-proc"]
    try:
        permitted = os.geteuid() == 0 and subprocess.run(
            [*words, "ip", "link", "set", "lo", "up"], capture_output=True,
            check=False).returncode == 0
    except FileNotFoundError:
        permitted = False
    os.environ[_ENTERED] = "yes" if permitted else "no"
    if permitted:
        os.execvp(words[0], [*words, sys.executable, "-B", *sys.argv])


def are_permitted():
    return os.environ.get(_ENTERED) == "yes"


def skip_unless_permitted(what):
    if not are_permitted():
        raise Skipped(f"{what}: needs root, unshare and ip, which are not "
                      "permitted or not there")


def mount_small_disk(path, mebibytes):
    """A file system of this size at an empty directory, gone with the matrix."""
    skip_unless_permitted("a small disk")
    run("mount", "-t", "tmpfs", "-o", f"size={mebibytes}M,mode=0755", "none", path)


class Network:
    """Hosts by name; the matrix itself is the host "clients". Each pair reaches
    the other by way of the hub, where what goes from one to the other can be
    dropped without a word to either."""

    _PREFIX = "198.18"

    def __init__(self, names):
        skip_unless_permitted("a network of its own")
        directory = pathlib.Path("/run/netns")
        directory.mkdir(exist_ok=True)
        if not os.path.ismount(directory):
            # Names that nobody else sees, and that are gone with the matrix.
            run("mount", "-t", "tmpfs", "none", directory)
        self._addresses = {}
        self._cuts = set()
        self._names = []
        try:
            self._add("hub")
            for name in names:
                self._add(name)
                self._join(name)
            self._join("clients")
            run("ip", "netns", "exec", "hub", "sysctl", "-qw",
                "net.ipv4.ip_forward=1")
        except BaseException:
            self.close()
            raise

    def _add(self, name):
        run("ip", "netns", "add", name)
        self._names.append(name)
        run("ip", "-n", name, "link", "set", "lo", "up")

    def _join(self, name):
        number = len(self._addresses) + 1
        here, there = (f"{self._PREFIX}.{number}.{last}" for last in (2, 1))
        self._addresses[name] = here
        inside = [] if name == "clients" else ["-n", name]
        run("ip", "-n", "hub", "link", "add", f"to-{name}", "type", "veth",
            "peer", "name", "eth-test", *(
                ["netns", os.getpid()] if name == "clients" else ["netns", name]))
        for options, device, address in (
                (["-n", "hub"], f"to-{name}", there), (inside, "eth-test", here)):
            run("ip", *options, "address", "add", f"{address}/24", "dev", device)
            run("ip", *options, "link", "set", device, "up")
        run("ip", *inside, "route", "add", f"{self._PREFIX}.0.0/16", "via", there)

    def address(self, name):
        return self._addresses[name]

    @staticmethod
    def on(name):
        """What a command begins with that is to run on a host."""
        return ["ip", "netns", "exec", name]

    def _rule(self, verb, source, target):
        run("ip", "-n", "hub", "rule", verb, "from", self.address(source), "to",
            self.address(target), "blackhole")

    def cut_one_way(self, source, target):
        """From now on nothing gets from the one to the other."""
        if (source, target) not in self._cuts:
            self._rule("add", source, target)
            self._cuts.add((source, target))

    def cut(self, one, other):
        self.cut_one_way(one, other)
        self.cut_one_way(other, one)

    def heal(self):
        for source, target in self._cuts:
            self._rule("del", source, target)
        self._cuts.clear()

    def close(self):
        """Everything on the hosts has to have ended."""
        # The kernel takes a namespace's links away some time after its name is gone;
        # the next network's link of this host would be refused until then.
        if "clients" in self._addresses:
            run("ip", "link", "delete", "eth-test")
        for name in reversed(self._names):
            run("ip", "netns", "delete", name)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()
