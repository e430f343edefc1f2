"""deploy/compose: what docker-compose reads in it is there, and fits together."""

import json
import os
import pathlib
import re
import shutil
import subprocess

import pytest
import yaml

ROOT = pathlib.Path(__file__).resolve().parents[2]
COMPOSE = ROOT / "deploy/compose"
BIN = pathlib.Path(os.environ["REVISIT_BIN"])
SERVERS = [f"revisitd-{number}" for number in (1, 2, 3)]


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """A copy of deploy/ for which the files have been prepared."""
    copy = tmp_path_factory.mktemp("tree")
    shutil.copytree(ROOT / "deploy", copy / "deploy",
                    ignore=shutil.ignore_patterns("files"))
    subprocess.run([copy / "deploy/compose/prepare"], check=True)
    return copy


@pytest.fixture(scope="module")
def services(tree):
    """As docker-compose understands the file."""
    said = subprocess.run(
        ["docker-compose", "--file", tree / "deploy/compose/compose.yaml",
         "config"], capture_output=True, text=True, check=False)
    assert (said.returncode, said.stderr) == (0, "")
    return yaml.safe_load(said.stdout)["services"]


def test_every_file_that_is_mounted_is_there(services, tree):
    mounted = [volume.split(":")[0] for service in services.values()
               for volume in service.get("volumes", ())
               if volume.startswith("/")]
    assert len(mounted) > 10
    assert [path for path in mounted if not pathlib.Path(path).exists()] == []
    assert all(pathlib.Path(path).is_relative_to(tree) for path in mounted)


def test_servers_have_the_addresses_that_envoy_and_prometheus_know(services):
    addresses = [services[name]["networks"]["backend"]["ipv4_address"]
                 for name in SERVERS]
    assert [services[name]["environment"]["REVISIT_ADVERTISE_ADDRESS"]
            for name in SERVERS] == [f"{one}:50051" for one in addresses]
    listed = (COMPOSE / "servers.yaml").read_text()
    assert re.findall(r"address: ([\d.]+), port_value: 50051", listed) == addresses
    scraped = {one["job_name"]: one["static_configs"][0]["targets"]
               for one in yaml.safe_load((
                   COMPOSE / "prometheus.yml").read_text())["scrape_configs"]}
    assert scraped == {"revisit": [f"{name}:9464" for name in SERVERS],
                       "revisit-console": ["console:9465"]}


def test_only_envoy_is_reached_from_other_machines(services):
    published = {name: port for name, service in services.items()
                 for port in service.get("ports", ())}
    assert published == {
        "envoy": {"published": 50051, "target": 50051},
        "console": "127.0.0.1:8080:8080/tcp",
        "prometheus": "127.0.0.1:9090:9090/tcp",
        "grafana": "127.0.0.1:3000:3000/tcp"}
    assert not [name for name in [*SERVERS, "database", "migrate"]
                if set(services[name]["networks"]) != {"backend"}]


def test_containers_have_no_rights_and_no_disk_but_their_volumes(services):
    for name, service in services.items():
        if name == "database":
            # Which makes itself the user that it runs as.
            continue
        assert service["read_only"], name
        assert service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name


def test_server_takes_its_settings(tree, tmp_path):
    settings = tmp_path / "revisitd.conf"
    settings.write_text((COMPOSE / "revisitd.conf").read_text().replace(
        "/etc/revisit/files", str(tree / "deploy/compose/files")))
    said = subprocess.run(
        [BIN / "revisitd", "--config", settings, "--print-config"],
        capture_output=True, text=True, check=False,
        env={"PATH": os.environ["PATH"]})
    assert said.returncode == 0, said.stderr
    assert "max-stream-age-seconds = 1800" in said.stdout


@pytest.mark.parametrize(("name", "host"), [
    ("edge", "localhost"), ("edge", "envoy"), ("server", "revisitd"),
    ("envoy", "envoy")])
def test_certificates_are_of_the_names_that_are_asked_for(name, host, tree):
    files = tree / "deploy/compose/files"
    said = subprocess.run(
        ["openssl", "verify", "-CAfile", files / "servers-ca.pem",
         "-verify_hostname", host, files / f"{name}.pem"],
        capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stderr
    keys = {subprocess.run(["openssl", *command], check=True,
                           capture_output=True).stdout
            for command in (["pkey", "-pubout", "-in", files / f"{name}.key"],
                            ["x509", "-pubkey", "-noout", "-in",
                             files / f"{name}.pem"])}
    assert len(keys) == 1


def test_files_that_are_there_are_not_made_again(tree):
    policy = tree / "deploy/compose/files/policy.json"
    before = [path.stat().st_mtime_ns for path in sorted(policy.parent.iterdir())]
    subprocess.run([tree / "deploy/compose/prepare"], check=True)
    after = [path.stat().st_mtime_ns for path in sorted(policy.parent.iterdir())]
    assert before == after
    assert json.loads(policy.read_text())["version"] == 1
    assert not (policy.parent / "ca.key").exists()
