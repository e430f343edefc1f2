"""How the command line explains itself: help, what was mistyped, wrong usage as
JSON, and where connection flags come from."""

import json

import pytest

from identities import Authority, replace
from revisit_server import Server, clean_environment, run

USAGE = 64


def commands_below(*path):
    """The names that the help lists as commands."""
    shown = run("revisit", "help", *path).stdout
    if "\nCommands:\n" not in shown:
        return []
    listed = shown.split("\nCommands:\n")[1].split("\n\n")[0]
    return [line.split()[0] for line in listed.splitlines()
            if line.startswith("  ") and not line.startswith("   ")]


def all_commands(*path):
    below = [(*path, name) for name in commands_below(*path)]
    return below + [deeper for command in below
                    for deeper in all_commands(*command)]


def test_help_of_every_command_is_that_of_its_flag():
    commands = all_commands()
    assert {("vehicle", "create"), ("closures", "delete"),
            ("info",)} <= set(commands)
    for command in commands:
        helped = run("revisit", "help", *command)
        assert (helped.returncode, helped.stderr) == (0, "")
        assert helped.stdout == run("revisit", *command, "--help").stdout
        assert f"Usage: revisit {' '.join(command)} [OPTIONS]" in helped.stdout


def test_help_keeps_to_the_width_of_the_terminal():
    for command in [(), ("vehicle", "create"), ("evaluate",), ("export",)]:
        for width in (50, 80, 95):
            shown = run("revisit", "help", *command,
                        env=clean_environment(COLUMNS=str(width))).stdout
            # A word that is longer has a line of its own.
            assert [line for line in shown.splitlines()
                    if len(line) > width and len(line.split()) > 1] == []
        # Elsewhere than on a terminal.
        shown = run("revisit", "help", *command).stdout
        assert 70 < max(map(len, shown.splitlines())) <= 80


@pytest.mark.parametrize("arguments, words", [
    (["stram", "drive.csv"], 'got "stram"; did you mean stream? allowed is'),
    (["vehicle", "craete", "x"], 'got "craete"; did you mean create? '),
    (["help", "vehicle", "updte"], 'got "updte"; did you mean update? '),
    (["help", "nothing-like-it"], 'got "nothing-like-it"; allowed is vehicle'),
    (["find", "x", "--max-candidate", "5"],
     'got "--max-candidate", which is no flag of revisit find; did you mean '
     "--max-candidates?"),
    (["find", "--vehcle", "x"], "did you mean --vehicle?"),
    (["find", "x", "--sever=a"], "did you mean --server?"),
    (["find", "x", "y"], 'got "y", which revisit find has no place for'),
], ids=str)
def test_what_is_mistyped_is_told_with_what_may_be_meant(arguments, words):
    result = run("revisit", *arguments)
    assert result.returncode == USAGE, result
    assert words in result.stderr
    assert result.stderr.splitlines()[-1].endswith(" --help tells more")


@pytest.mark.parametrize("arguments", [
    [], ["stram"], ["find"], ["find", "x", "--sequence", "-1"],
    ["find", "x", "--no-such-flag"], ["vehicle", "delete", "x"],
    ["vehicle", "update", "x"]], ids=str)
def test_wrong_usage_is_json_where_json_is_asked_for(arguments):
    for asked in (["--json"], ["-o", "json"], ["-o=json"]):
        result = run("revisit", *arguments, *asked)
        assert (result.returncode, result.stdout) == (USAGE, "")
        error = json.loads(result.stderr)["error"]
        assert error["reason"] == "USAGE"
        assert error["message"] and "--help" in error["hint"]


@pytest.mark.parametrize("arguments, has", [
    (["info"], "json, text"), (["export", "x"], "json, text"),
    (["vehicle", "get", "x"], "json, name, text"),
    (["poses", "list", "x"], "json, text, wide"),
    (["find", "x"], "json, name, text, wide")], ids=str)
def test_format_that_there_is_not_is_refused_with_what_the_command_has(
        arguments, has):
    result = run("revisit", *arguments, "-o", "yaml")
    assert result.returncode == USAGE
    assert result.stderr.startswith(f'-o: got "yaml"; allowed is {has}\n')


POLICY = {"version": 1, "tenants": [],
          "grants": [{"certificate_uri": "spiffe://fleet.example/backend",
                      "tenant": "*", "vehicles": ["*"],
                      "verbs": ["read", "write", "admin"]}]}


@pytest.fixture(scope="module")
def secured(tmp_path_factory):
    """A server that asks for a certificate, and the variables of a client that
    has one."""
    folder = tmp_path_factory.mktemp("secured")
    authority = Authority()

    def written(name, content):
        return replace(folder / name, content)

    own = authority.issue_for_server()
    client = authority.issue("spiffe://fleet.example/backend")
    flags = ["--tls-cert", written("server.pem", own.pem),
             "--tls-key", written("server.key", own.key_pem),
             "--tls-client-ca", written("ca.pem", authority.pem),
             "--policy", written("policy.json", json.dumps(POLICY))]
    variables = {
        "REVISIT_TLS_CA": str(folder / "ca.pem"),
        "REVISIT_TLS_CERT": str(written("client.pem", client.pem)),
        "REVISIT_TLS_KEY": str(written("client.key", client.key_pem))}
    with Server(folder / "store", *flags) as running:
        yield {"REVISIT_SERVER": running.address, **variables}


def test_connection_comes_from_the_environment(secured):
    listed = run("revisit", "vehicle", "list", env=clean_environment(**secured))
    assert listed.returncode == 0, listed.stderr
    less = {name: value for name, value in secured.items()
            if name not in ("REVISIT_TLS_CERT", "REVISIT_TLS_KEY")}
    refused = run("revisit", "vehicle", "list", env=clean_environment(**less))
    assert refused.returncode != 0


def test_flag_wins_over_its_variable(secured, tmp_path):
    result = run("revisit", "vehicle", "list", "--tls-ca", tmp_path / "none",
                 env=clean_environment(**secured))
    assert result.returncode == 1
    assert f"cannot read {tmp_path / 'none'}" in result.stderr


def test_variables_that_do_not_go_together_are_told(secured):
    alone = run("revisit", "vehicle", "list", env=clean_environment(
        REVISIT_TLS_CERT=secured["REVISIT_TLS_CERT"]))
    assert alone.returncode == USAGE
    assert "--tls-cert requires --tls-" in alone.stderr


def test_token_file_may_come_from_the_environment(tmp_path):
    missing = run("revisit", "vehicle", "list", env=clean_environment(
        REVISIT_TOKEN_FILE=str(tmp_path / "token")))
    assert missing.returncode == 1
    assert f"cannot read {tmp_path / 'token'}" in missing.stderr


def test_help_needs_nothing_of_what_the_variables_name(tmp_path):
    (tmp_path / "contexts.json").write_text("nothing like it")
    environment = clean_environment(
        REVISIT_TLS_CA=str(tmp_path / "none"), REVISIT_CONTEXT="none",
        REVISIT_CONTEXTS_FILE=str(tmp_path / "contexts.json"))
    for words in (["help"], ["find", "--help"], ["--version"],
                  ["completion", "bash"]):
        assert run("revisit", *words, env=environment).returncode == 0


def test_server_starts_where_the_client_has_its_variables(tmp_path):
    printed = run("revisitd", "--print-config", env=clean_environment(
        REVISIT_SERVER="x:1", REVISIT_TLS_CA="ca.pem",
        REVISIT_TOKEN_FILE="token", REVISIT_CONTEXT="plant",
        REVISIT_CONTEXTS_FILE="contexts.json"))
    assert printed.returncode == 0, printed.stderr
