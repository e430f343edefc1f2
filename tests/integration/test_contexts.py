"""Named contexts of the command line: their file, their commands, and which server a
command asks."""

import json
import os
import stat
import subprocess

import pytest

from revisit_server import BIN, clean_environment, run
from stubs import ROOT

USAGE = 64
LOCAL = 1


@pytest.fixture
def contexts(tmp_path):
    """Runs `revisit` with a file of contexts of its own."""
    file = tmp_path / "config" / "revisit" / "contexts.json"

    def call(*arguments, **variables):
        return run("revisit", *arguments, cwd=tmp_path, env=clean_environment(
            XDG_CONFIG_HOME=str(tmp_path / "config"), **variables))

    def done(*arguments, **variables):
        result = call(*arguments, **variables)
        assert result.returncode == 0, result
        return result.stdout

    call.done = done
    call.file = file
    return call


@pytest.fixture
def named(contexts):
    """The same with two contexts, of which `plant` is the current one."""
    contexts.done("context", "set", "plant", "--server", "127.0.0.1:1")
    contexts.done("context", "set", "yard", "--server", "127.0.0.2:1")
    contexts.done("context", "use", "plant")
    return contexts


def asked(result):
    """Whom a command asked that found nobody there."""
    assert result.returncode == 64 + 14, result
    return result.stderr.split("(is revisitd running at ")[1].split("?")[0]


def test_evaluate_leaves_a_current_context_alone(contexts, tmp_path):
    contexts.done("context", "set", "plant", "--server", "127.0.0.1:1",
                  "--tls-ca", "missing.pem")
    contexts.done("context", "use", "plant")
    drive = tmp_path / "drive.csv"
    shipped = ROOT / "tests/data/boreas/boreas_glen_shields.csv"
    drive.write_text("\n".join(shipped.read_text().splitlines()[:400]) + "\n")
    result = contexts("evaluate", drive, "--uncertainty", "file", "--json")
    assert result.returncode == 0, result
    assert json.loads(result.stdout)["methods"]
    # Where it is named, it counts.
    result = contexts("evaluate", drive, "--uncertainty", "file",
                      "--context", "plant", "--json")
    assert result.returncode == LOCAL
    assert "missing.pem" in result.stderr and "plant" in result.stderr


def test_context_is_set_listed_shown_and_deleted(named, tmp_path):
    named.done("context", "set", "yard", "--token-file", "yard.token")
    held = json.loads(named.file.read_text())
    assert held == {"current": "plant", "contexts": {
        "plant": {"server": "127.0.0.1:1"},
        "yard": {"server": "127.0.0.2:1",
                 "token-file": str(tmp_path / "yard.token")}}}
    assert stat.S_IMODE(os.stat(named.file).st_mode) == 0o600
    table = named.done("context", "list").splitlines()
    assert [line.split() for line in table[1:]] == [
        ["*", "plant", "127.0.0.1:1"], ["yard", "127.0.0.2:1", "token"]]
    assert str(tmp_path / "yard.token") in named.done("context", "list", "-o", "wide")
    assert named.done("context", "list", "-o", "name") == "plant\nyard\n"
    listed = json.loads(named.done("context", "list", "--json"))["contexts"]
    assert listed[1] == {"context": "yard", "current": False,
                         "server": "127.0.0.2:1",
                         "tokenFile": str(tmp_path / "yard.token")}
    shown = json.loads(named.done("context", "show", "yard", "-o", "json"))
    assert (shown["context"], shown["server"]) == ("yard", "127.0.0.2:1")
    # An empty value takes a file away.
    named.done("context", "set", "yard", "--token-file", "")
    assert "token-file" not in named.file.read_text()
    assert "which was the current one" in named.done("context", "delete", "plant")
    assert json.loads(named.file.read_text()) == {
        "contexts": {"yard": {"server": "127.0.0.2:1"}}}


@pytest.mark.parametrize("flags, variables, address, chosen_by", [
    ([], {}, "127.0.0.1:1", "revisit context use"),
    ([], {"REVISIT_CONTEXT": "yard"}, "127.0.0.2:1", "REVISIT_CONTEXT"),
    ([], {"REVISIT_SERVER": "127.0.0.3:1"}, "127.0.0.3:1", None),
    (["--context", "yard"], {"REVISIT_SERVER": "127.0.0.3:1"}, "127.0.0.2:1",
     "--context"),
    (["--context", "yard"], {"REVISIT_CONTEXT": "plant"}, "127.0.0.2:1",
     "--context"),
    (["--server", "127.0.0.4:1"], {"REVISIT_CONTEXT": "yard"}, "127.0.0.4:1",
     None),
], ids=str)
def test_flag_counts_before_variable_before_current_context(
        flags, variables, address, chosen_by, named):
    result = named("info", *flags, **variables)
    assert asked(result) == address
    if chosen_by is None:
        assert "context" not in result.stderr
    else:
        assert f"in {named.file}, chosen by {chosen_by}, names" in result.stderr
    shown = named.done("context", "show", *flags, **variables)
    assert address in shown


def test_default_is_asked_without_any_context(contexts):
    shown = json.loads(contexts.done("context", "show", "--json"))
    assert shown == {"chosenBy": "the default", "file": str(contexts.file),
                     "server": "127.0.0.1:50051"}
    assert not contexts.file.exists()


def test_two_servers_at_once_are_refused(named):
    flags = named("info", "--server", "x:1", "--context", "yard")
    assert (flags.returncode, flags.stderr.splitlines()[0]) == (
        USAGE, "--server, --context: one of them only")
    variables = named("info", REVISIT_SERVER="x:1", REVISIT_CONTEXT="yard")
    assert (variables.returncode, variables.stderr.splitlines()[0]) == (
        USAGE, "REVISIT_SERVER, REVISIT_CONTEXT: one of them only")


def test_credentials_stay_with_their_server(named, tmp_path):
    """A token of the environment or of a context is not shown to a server that
    another of the two has named."""
    named.done("context", "set", "plant", "--token-file", "plant.token")
    plant = str(tmp_path / "plant.token")

    def token(*flags, **variables):
        shown = named.done("context", "show", "--json", *flags, **variables)
        return json.loads(shown).get("tokenFile")

    assert token() == plant
    assert token(REVISIT_SERVER="127.0.0.1:9") is None
    assert token("--server", "127.0.0.1:9") is None
    assert token("--context", "plant", REVISIT_TOKEN_FILE="other") == plant
    assert token("--context", "yard", REVISIT_TOKEN_FILE="other") is None
    # What is given beside a context that was not named by a flag is meant.
    assert token(REVISIT_TOKEN_FILE="other") == "other"
    assert token("--token-file", "own") == "own"
    assert token("--context", "plant", "--token-file", "own") == "own"
    missing = named("info")
    assert missing.returncode == LOCAL
    assert f"cannot read {plant}" in missing.stderr
    assert "(the context plant in " in missing.stderr


def test_wrong_file_is_told_by_name_and_key_where_it_is_needed(named):
    named.file.write_text('{"contexts": {"a": {"server": "x", "tls-cert": 1}}}')
    for words in (["info"], ["info", "--context", "a"], ["context", "list"],
                  ["context", "set", "b", "--server", "y:1"]):
        refused = named(*words)
        assert refused.returncode == LOCAL, refused
        assert f"{named.file}: contexts.a.tls-cert: " in refused.stderr
    assert asked(named("info", "--server", "127.0.0.1:1")) == "127.0.0.1:1"
    named.file.write_text('{"contexts": {}, "curent": "a"}')
    assert 'key: got "curent"; did you mean current?' in named("info").stderr


@pytest.mark.parametrize("words, message", [
    (["set", "new", "--tls-ca", "ca.pem"], "--server is missing"),
    (["set", "new"], "--server, or another flag to keep, is required"),
    (["set", "a b", "--server", "x:1"], 'CONTEXT: got "a b"; allowed are'),
    (["set", "new", "--server", "x:1", "--tls-ca", "ca", "--tls-key", "k"],
     "--tls-key requires --tls-cert"),
], ids=str)
def test_context_that_is_not_whole_is_not_set(words, message, named):
    before = named.file.read_text()
    refused = named("context", *words, REVISIT_SERVER="env:1")
    assert refused.returncode == USAGE
    assert refused.stderr.startswith(message)
    assert named.file.read_text() == before


def test_context_that_there_is_not_is_told(named):
    for words in (["use", "plnt"], ["show", "plnt"], ["delete", "plnt"]):
        refused = named("context", *words)
        assert refused.returncode == LOCAL
        assert 'has no context "plnt"; did you mean plant?' in refused.stderr
        assert "it has plant, yard" in refused.stderr


def test_contexts_that_many_set_at_once_are_all_kept(contexts, tmp_path):
    running = [subprocess.Popen(
        [BIN / "revisit", "context", "set", f"c{i}", "--server", f"h{i}:1"],
        env=clean_environment(XDG_CONFIG_HOME=str(tmp_path / "config")),
        stdout=subprocess.DEVNULL) for i in range(20)]
    assert [process.wait() for process in running] == [0] * 20
    names = contexts.done("context", "list", "-o", "name").split()
    assert names == sorted(f"c{i}" for i in range(20))
    assert sorted(path.name for path in contexts.file.parent.iterdir()) == [
        "contexts.json", "contexts.json.lock"]
