"""A private PostgreSQL, started, harmed and stopped by the fault matrix."""

import contextlib
import functools
import os
import pathlib
import pwd
import shutil
import signal
import subprocess
import time

from hosts import run
from revisit_server import free_port, wait_until
from skipped import Skipped

# Where Debian keeps the programs of the newest server.
_INSTALLED = sorted(pathlib.Path("/usr/lib/postgresql").glob("*/bin"),
                    key=lambda path: int(path.parent.name))
PROGRAMS = pathlib.Path(os.environ.get("REVISIT_TEST_POSTGRES") or
                        (_INSTALLED or ["/usr/lib/postgresql"])[-1])
USER = "revisit"
DATABASE = "revisit"
START_SECONDS = 30
_SETTINGS = {
    "unix_socket_directories": "''", "fsync": "on", "synchronous_commit": "on",
    "shared_buffers": "32MB", "max_connections": "100", "wal_level": "replica",
    "max_wal_senders": "5", "wal_keep_size": "256MB", "max_wal_size": "256MB",
    "hot_standby": "on", "lc_messages": "'C'", "timezone": "'UTC'",
    # Both find a host that is gone sooner than by default.
    "wal_sender_timeout": "'10s'", "wal_receiver_timeout": "'10s'",
    "deadlock_timeout": "'200ms'", "log_line_prefix": "'%m [%p] '",
}


class Refused(Exception):
    """psql failed."""


def skip_without_postgres():
    for program in ("postgres", "initdb", "pg_basebackup", "psql"):
        if not os.access(PROGRAMS / program, os.X_OK):
            raise Skipped(f"there is no {PROGRAMS / program}: Debian's package "
                          "postgresql has it")


@functools.cache
def _as_nobody_special():
    """PostgreSQL refuses to run as root."""
    if os.geteuid() != 0:
        return []
    for name in ("postgres", "nobody"):
        with contextlib.suppress(KeyError):
            user = pwd.getpwnam(name)
            return ["setpriv", f"--reuid={user.pw_uid}", f"--regid={user.pw_gid}",
                    "--clear-groups", "--"]
    raise Skipped("there is no user whom PostgreSQL could run as")


def _own(path):
    """Gives a directory to the user of PostgreSQL."""
    words = _as_nobody_special()
    if words:
        ids = [int(word.split("=")[1]) for word in words[1:3]]
        for directory, _, files in os.walk(path):
            os.chown(directory, *ids)
            for name in files:
                os.chown(os.path.join(directory, name), *ids)


def _run(*words):
    result = subprocess.run(
        [*_as_nobody_special(), *map(str, words)], capture_output=True, text=True,
        timeout=120, check=False, cwd="/", env={"LC_ALL": "C", "PATH": os.defpath})
    assert result.returncode == 0, (words, result.stdout, result.stderr)


def _empty_cluster(directory, template):
    """As initdb makes it, which takes seconds, and so only once."""
    if not template.exists():
        template.mkdir(mode=0o700)
        _own(template)
        _run(PROGRAMS / "initdb", "--no-sync", "--auth=trust", "--locale=C",
             "--encoding=UTF8", f"--username={USER}", "-D", template)
        (template / "pg_hba.conf").write_text(
            "host all all all trust\nhost replication all all trust\n")
    shutil.copytree(template, directory, dirs_exist_ok=True)


class Postgres:
    """One server of PostgreSQL 15 with its data in `directory` / data, in a
    directory of a row. `launch` is what its command begins with, as for another
    host."""

    def __init__(self, directory, host="127.0.0.1", launch=(), primary=None,
                 settings=(), mount=None):
        """A copy of `primary`, which streams from it, if that is given. `mount`
        gets the empty directory of the data before it is used."""
        skip_without_postgres()
        self.host, self.port = host, free_port()
        self.log_path = directory / "postgres.log"
        self.data = directory / "data"
        self._launch = list(launch)
        self._process = None
        self._is_mounted = mount is not None
        directory.mkdir(parents=True, exist_ok=True)
        # Others than root have to get there.
        for parent in (directory, *directory.parents[:3]):
            if parent.stat().st_mode & 0o077 == 0:
                parent.chmod(0o711)
        self.data.mkdir(mode=0o700)
        if mount is not None:
            mount(self.data)
        _own(directory)
        self.data.chmod(0o700)
        if primary is None:
            _empty_cluster(self.data, directory.parents[2] / "postgres-template")
            _own(self.data)
        else:
            _run(PROGRAMS / "pg_basebackup", "-D", self.data, "-R", "-X",
                 "stream", "-c", "fast", "-d",
                 primary.conninfo("postgres", application_name="standby"))
        lines = {**_SETTINGS, **dict(settings), "listen_addresses": f"'{host}'",
                 "port": self.port}
        (self.data / "postgresql.conf").write_text("".join(
            f"{name} = {value}\n" for name, value in lines.items()))
        self.start()
        if primary is None:
            self.sql(f"CREATE DATABASE {DATABASE}", database="postgres")

    def conninfo(self, database=DATABASE, **more):
        return " ".join(f"{name}={value}" for name, value in {
            "host": self.host, "port": self.port, "user": USER,
            "dbname": database, **more}.items())

    @property
    def address(self):
        return f"{self.host}:{self.port}"

    def url(self, *others, **parameters):
        """For --store, of this server and others that take its place."""
        return url_of(self.address, *(other.address for other in others),
                      **parameters)

    def free_bytes(self):
        status = os.statvfs(self.data)
        return status.f_bavail * status.f_frsize

    def log(self):
        return self.log_path.read_text(errors="replace")

    # Running.

    def start(self, wait=True):
        with open(self.log_path, "ab") as log:
            self._process = subprocess.Popen(
                [*self._launch, *_as_nobody_special(), PROGRAMS / "postgres", "-D",
                 self.data], stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                cwd="/", env={"LC_ALL": "C", "PATH": os.defpath})
        if wait:
            self.wait_until_ready()

    def wait_until_ready(self):
        def ready():
            if self._process.poll() is not None:
                # What a killed one has left in memory goes with its processes.
                assert "pre-existing shared memory" in self.log() or \
                    "lock file" in self.log(), self.log()[-2000:]
                self.start(wait=False)
                time.sleep(0.05)
            with contextlib.suppress(Refused):
                return self.sql("SELECT 1", database="postgres")

        wait_until(ready, "PostgreSQL", START_SECONDS)

    def is_running(self):
        return self._process is not None and self._process.poll() is None

    def stop(self, mode="fast"):
        """`mode`: fast, immediate, or kill, which is -9 to every process."""
        if not self.is_running():
            return
        if mode == "kill":
            for pid in [self._process.pid, *self._children()]:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        else:
            self._process.send_signal({"fast": signal.SIGINT,
                                       "immediate": signal.SIGQUIT}[mode])
        self._process.wait(60)

    def _children(self):
        return list(map(int, pathlib.Path(
            f"/proc/{self._process.pid}/task/{self._process.pid}/children"
        ).read_text().split()))

    def restart(self, mode="fast"):
        self.stop(mode)
        self.start()

    def pause(self):
        """Stops every process, as if the machine hung."""
        for pid in [self._process.pid, *self._children()]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGSTOP)

    def resume(self):
        for pid in [*self._children(), self._process.pid]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)

    def promote(self):
        self.sql("SELECT pg_promote(true, 30)", database="postgres")

    # Asking.

    def sql(self, text, database=DATABASE, timeout=30):
        """The rows of the last statement, as tuples of texts."""
        try:
            result = subprocess.run(
                [PROGRAMS / "psql", "-XAtq", "-F", "\t", "-v", "ON_ERROR_STOP=1", "-d",
                 self.conninfo(database, connect_timeout=5), "-c", text],
                capture_output=True, text=True, timeout=timeout, check=False,
                env={"LC_ALL": "C", "PATH": os.defpath})
        except subprocess.TimeoutExpired as expired:
            raise Refused(f"no answer in {timeout} s: {text}") from expired
        if result.returncode != 0:
            raise Refused(result.stderr.strip())
        return [tuple(line.split("\t")) for line in result.stdout.splitlines()]

    def set(self, **settings):
        """Settings that need no restart."""
        for name, value in settings.items():
            self.sql(f"ALTER SYSTEM SET {name} = '{value}'")
        self.sql("SELECT pg_reload_conf()")

    def wait_for_standby(self, state):
        """Until the standby is of this kind: sync or async."""
        wait_until(lambda: self.sql(
            "SELECT 1 FROM pg_stat_replication WHERE state = 'streaming' AND "
            f"sync_state = '{state}'"), f"{state} standby")

    def wait_for_replay(self, standby):
        """Until the standby has all that was committed here."""
        position, = self.sql("SELECT pg_current_wal_lsn()")[0]
        wait_until(lambda: standby.sql(
            f"SELECT 1 WHERE pg_last_wal_replay_lsn() >= '{position}'"),
            "standby that has all")

    def close(self):
        if self.is_running():
            self.resume()
            self.stop("immediate")
        if self._is_mounted:
            run("umount", self.data)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def url_of(*addresses, **parameters):
    query = "&".join(f"{name}={value}" for name, value in {
        "sslmode": "disable", "gssencmode": "disable", **parameters}.items())
    return f"postgresql://{USER}@{','.join(addresses)}/{DATABASE}?{query}"
