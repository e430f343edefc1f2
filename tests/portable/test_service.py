"""The archive's service starts on a machine with systemd, as its document says."""

import os

import pytest

from test_archive import ARCHIVE, COMMANDS, NAME, service_commands

if "REVISIT_BASE" not in os.environ:
    pytest.skip("tests/portable/run could make no machine with systemd",
                allow_module_level=True)
from machine import booted_machine


@pytest.fixture
def machine():
    with booted_machine() as made:
        yield made


def test_the_service_starts_with_the_commands_of_the_document(machine):
    (machine.root / "root" / ARCHIVE.name).write_bytes(ARCHIVE.read_bytes())
    unpack = "tar" + COMMANDS["sudo tar"].replace("revisit-VERSION-linux-ARCH", NAME)
    machine.run("sh", "-euc", f"cd; {unpack}")
    for command in service_commands():
        machine.run("sh", "-euc", command)
    assert machine.show("ActiveState") == "active"
    assert "SERVING" in machine.run("/usr/local/bin/revisit", "health")
    assert machine.run("stat", "--format=%U", "/var/lib/revisit").strip() == "revisit"
