"""A real revisitd, started and stopped by the tests."""

import contextlib
import os
import pathlib
import queue
import random
import re
import resource
import signal
import socket
import subprocess
import threading
import time

import grpc

from stubs import ROOT, PoseGraphServiceStub

BIN = pathlib.Path(os.environ.get("REVISIT_BIN", ROOT / "build/release/bin"))

START_SECONDS = 30
STOP_SECONDS = 30
# A program that takes longer hangs, on however busy a machine.
RUN_SECONDS = 240


def clean_environment(**extra):
    """The environment without settings of revisitd and without the contexts of
    whoever runs the tests, plus some."""
    kept = {name: value for name, value in os.environ.items()
            if not name.startswith("REVISIT_")}
    # Nobody can make anything there, root included.
    kept["XDG_CONFIG_HOME"] = "/proc/nonexistent"
    # A program with the sanitizer sets aside what it frees, 256 MiB of it, which
    # is none of the memory that tests measure.
    kept.setdefault("ASAN_OPTIONS", "quarantine_size_mb=16")
    return {**kept, **extra}


def run(*arguments, env=None, timeout=RUN_SECONDS, cwd=None):
    """Runs one of our programs to its end."""
    program, *rest = arguments
    return subprocess.run(
        [BIN / program, *map(str, rest)], capture_output=True, text=True,
        env=env or clean_environment(), timeout=timeout, cwd=cwd, check=False)


def wait_until(condition, what, seconds=START_SECONDS):
    """Waits for a condition that nothing announces."""
    deadline = time.monotonic() + seconds
    while True:
        value = condition()
        if value:
            return value
        assert time.monotonic() < deadline, f"no {what} within {seconds} s"
        time.sleep(0.002)


def wait_until_none_left(count, what, seconds=START_SECONDS):
    """Waits until a count is 0, for as long as it goes on falling: how long all of it
    takes depends on the machine."""
    least, deadline = None, time.monotonic() + seconds
    while (left := count()) > 0:
        if least is None or left < least:
            least, deadline = left, time.monotonic() + seconds
        assert time.monotonic() < deadline, f"{left} {what} left for {seconds} s"
        time.sleep(0.01)


def wait_until_still(value, seconds=600.0):
    """Waits until a value has stayed the same for several times as long as it ever
    did before, and a second at least; answers it."""
    begun = changed = time.monotonic()
    last, longest = value(), 0.3
    while (now := time.monotonic()) < changed + 4 * longest:
        assert now < begun + seconds, f"moves after {seconds} s"
        time.sleep(0.02)
        if (found := value()) != last:
            longest = max(longest, now - changed)
            last, changed = found, time.monotonic()
    return last


def is_crowded():
    """Whether long queues have waited at this machine's processors for the last
    minute. What is promised in seconds is promised of others."""
    return os.getloadavg()[0] > 2 * os.cpu_count()


def processor_seconds(pid):
    """Processor time of a process so far."""
    stat = pathlib.Path(f"/proc/{pid}/stat").read_text()
    user, system = map(int, stat.rpartition(")")[2].split()[11:13])
    return (user + system) / os.sysconf("SC_CLK_TCK")


def open_files(pid):
    """Names of the files that a process has open, a line each."""
    names = []
    for descriptor in pathlib.Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(OSError):
            names.append(os.readlink(descriptor))
    return "\n".join(names)


_held_ports = []


def free_port():
    """A port to listen at that nobody else takes until this process ends. It is
    below those that Linux gives to connections, and held by a socket that does
    not listen: that keeps other tests from it, but not a program that reuses
    addresses, as servers do."""
    while True:
        port = random.randrange(20000, 32768)
        holder = socket.socket()
        try:
            holder.bind(("127.0.0.1", port))
        except OSError:
            holder.close()
            continue
        # Not before it is bound, or it could be bound beside such a program.
        holder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        _held_ports.append(holder)
        return port


class Server:
    """One revisitd on a free port of the loopback, over one store, which is a
    path or a URL. It may open as many files as `descriptors` says, if it says.
    Its log goes to a file beside the store, or to `log_path`, or to the
    descriptor `stderr`. Its input is `stdin`. `launch` is what its command
    begins with."""

    def __init__(self, store, *flags, env=None, wait=True, descriptors=None,
                 listen="127.0.0.1:0", log_path=None, stderr=None,
                 stdin=subprocess.DEVNULL, launch=()):
        self.store = store if "://" in str(store) else pathlib.Path(store)
        self.log_path = log_path or self.store.with_name(
            self.store.name + ".log")
        self.host = listen.rpartition(":")[0]
        self._lines = queue.SimpleQueue()
        self._channels = []
        self.port = None
        # HOST:PORT of metrics and probes, if they are served.
        self.admin = None
        with open(self.log_path, "ab") as log:
            self.process = subprocess.Popen(
                [*launch, BIN / "revisitd", "--listen", listen, "--store",
                 self.store, *map(str, flags)],
                stdin=stdin, stdout=subprocess.PIPE,
                stderr=log if stderr is None else stderr,
                text=True, env=env or clean_environment(),
                preexec_fn=descriptors and (lambda: resource.setrlimit(
                    resource.RLIMIT_NOFILE, (descriptors, descriptors))))
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        if wait:
            self.wait_until_listening()

    def _read(self):
        for line in self.process.stdout:
            self._lines.put(line)
        self._lines.put(None)

    def wait_until_listening(self):
        deadline = time.monotonic() + START_SECONDS
        while self.port is None:
            line = self._lines.get(timeout=deadline - time.monotonic())
            assert line is not None, (
                f"revisitd ended with {self.process.wait()}: {self.log()}")
            admin = re.match(r"admin listening on (\S+)\s*$", line)
            if admin:
                self.admin = admin.group(1)
            found = re.match(
                rf"listening on {re.escape(self.host)}:(\d+)\s*$", line)
            if found:
                self.port = int(found.group(1))

    @property
    def pid(self):
        return self.process.pid

    @property
    def address(self):
        return f"{self.host}:{self.port}"

    def log(self):
        return self.log_path.read_text(errors="replace")

    def logged(self, text, count=1):
        """Waits until so many lines of the log have this in them, for it is
        written beside the calls; answers them."""

        def lines():
            found = [line for line in self.log().splitlines() if text in line]
            return len(found) >= count and found

        return wait_until(lines, f"{text!r} in the log")

    def is_running(self):
        return self.process.poll() is None

    def channel(self, *options):
        return self.keep(grpc.insecure_channel(self.address, options=options))

    def keep(self, channel):
        """A channel to this server, which is closed with it."""
        self._channels.append(channel)
        return channel

    def stub(self):
        return PoseGraphServiceStub(self.channel())

    def resident_bytes(self):
        with open(f"/proc/{self.pid}/statm") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    def kill(self):
        """The crash: no clean-up of any kind."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(STOP_SECONDS)
        self._forget()

    def close(self):
        """Makes sure that it is gone, whatever the test did."""
        # A client that is idle here hears late of a server that shuts down.
        self.close_channels()
        if self.is_running():
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(STOP_SECONDS)
            except subprocess.TimeoutExpired:
                self.kill()
        self._forget()

    def close_channels(self):
        for channel in self._channels:
            channel.close()
        self._channels.clear()

    def _forget(self):
        self.close_channels()
        self._reader.join(STOP_SECONDS)
        self.process.stdout.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()
