"""A PostgreSQL of a test's own, if this machine has one."""

import contextlib
import importlib
import pathlib
import shutil
import sys
import tempfile

import pytest

from revisit_server import run
from stubs import ROOT

sys.path.insert(0, str(ROOT / "deploy/cluster"))
private_cluster = importlib.import_module("private_cluster")


def exit_without_postgres():
    """Ends a file of tests that cannot do without it."""
    if private_cluster.find_postgres() is None:
        pytest.exit("there is no PostgreSQL: tests/run installs it", returncode=77)


@contextlib.contextmanager
def own_postgres():
    """Yields a private_cluster.Postgres with an empty database, or None without
    PostgreSQL."""
    if private_cluster.find_postgres() is None:
        yield None
        return
    directory = pathlib.Path(tempfile.mkdtemp(prefix="revisit-postgres-"))
    # PostgreSQL may have to enter it as another user.
    directory.chmod(0o711)
    try:
        with private_cluster.Processes(directory) as processes:
            yield private_cluster.Postgres(processes)
    finally:
        shutil.rmtree(directory, ignore_errors=True)


@contextlib.contextmanager
def own_shared_store():
    """Yields a private_cluster.Postgres with the tables of a store; ends the file of
    tests without PostgreSQL."""
    exit_without_postgres()
    with own_postgres() as postgres:
        migrated = run("revisitd", "migrate", "--store", postgres.url("revisit_owner"))
        assert migrated.returncode == 0, migrated.stderr
        yield postgres
