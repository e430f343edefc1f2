"""What deploy/monitoring says fits what servers say: its metrics are there, are
documented, and its alerts are told by what a server answers when it comes to harm."""

import contextlib
import json
import os
import pathlib
import re
import shutil
import sqlite3
import subprocess
import threading
import time
import urllib.parse

import pytest
import scraped
from identities import AUDIENCE, ISSUER, Authority, TokenKey, key_set
from own_postgres import own_postgres
from revisit_server import (BIN, Server, clean_environment, free_port, run,
                            wait_until)
from stubs import ROOT, api
from wire import append, laps, straight

MONITORING = ROOT / "deploy/monitoring"
ALERTS = MONITORING / "alerts.yml"
PROMTOOL = pathlib.Path(os.environ.get("REVISIT_TEST_PROMTOOL",
                                       ROOT / "build/tools/promtool"))
PROMETHEUS = pathlib.Path(os.environ.get("REVISIT_TEST_PROMETHEUS",
                                         ROOT / "build/tools/prometheus"))
ADMIN = ("--admin-listen", "127.0.0.1:0")
# Servers of a shared store are called by a name of theirs.
NAMED = ("--advertise-address", "host-a:1")
METRIC = re.compile(r"\b(?:revisit|process)_[a-z_]+\b")

needs_promtool = pytest.mark.skipif(
    not os.access(PROMTOOL, os.X_OK),
    reason="there is no promtool: tests/run takes it from Debian's package")


def promtool(*arguments, cwd=None):
    result = subprocess.run([PROMTOOL, *arguments], capture_output=True,
                            text=True, check=False, cwd=cwd)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout + result.stderr


def dashboard_expressions():
    dashboard = json.loads((MONITORING / "dashboard.json").read_text())
    return [target["expr"] for panel in dashboard["panels"]
            for target in panel.get("targets", [])]


def alerts():
    """(name, expression, annotations) of each rule. The file is written in one
    way, which needs no parser of YAML; promtool reads it with one."""
    rules = []
    for block in ALERTS.read_text().split("      - alert: ")[1:]:
        expression = re.search(
            r"^        expr: (?:\|\n((?:          .*\n)+)|(.*)\n)", block,
            re.MULTILINE)
        annotations = {
            name: value.strip() for name, value in re.findall(
                r"^          (\w+): (?:>-\n)?(.*)$",
                block.split("annotations:")[1], re.MULTILINE)}
        rules.append((block.split()[0],
                      expression.group(1) or expression.group(2), annotations))
    assert len(rules) > 15
    return rules


def metrics_of(expression):
    """Names in an expression, without what is added to those of histograms."""
    without_strings = re.sub(r'"[^"]*"', '""', expression)
    return {re.sub(r"_(bucket|count|sum)$", "", name)
            for name in METRIC.findall(without_strings)}


@pytest.fixture(scope="module")
def database():
    """A PostgreSQL of the tests' own, or None."""
    with own_postgres() as postgres:
        yield postgres


@pytest.fixture(scope="module")
def secured(tmp_path_factory):
    """A server with all that can be configured over a file."""
    directory = tmp_path_factory.mktemp("secured")
    key = TokenKey("EdDSA", "ed")
    authority = Authority()
    # Three days are left of its certificate.
    certificate = authority.issue("localhost", ends=3 * 86400)
    for name, content in [
            ("keys.json", key_set(key).encode()),
            ("policy.json", json.dumps({"version": 1, "tenants": [],
                                        "grants": []}).encode()),
            ("cert.pem", certificate.pem + authority.pem),
            ("key.pem", certificate.key_pem)]:
        (directory / name).write_bytes(content)
    # One that ended before it, and a backup.
    with Server(directory / "store"):
        pass
    assert run("revisitd", "backup", "--store", directory / "store", "--to",
               directory / "backup.sqlite").returncode == 0
    with Server(directory / "store", *ADMIN,
                "--audit-log", directory / "audit",
                "--tls-cert", directory / "cert.pem",
                "--tls-key", directory / "key.pem",
                "--token-keys", directory / "keys.json",
                "--token-issuer", ISSUER, "--token-audience", AUDIENCE,
                "--policy", directory / "policy.json") as server:
        yield server


@pytest.fixture(scope="module")
def kinds(secured, database, tmp_path_factory):
    """The kinds of all metrics, of a server over a file and of one over a
    database."""
    found = dict(scraped.scrape(secured).kinds)
    if database is None:
        pytest.skip("there is no PostgreSQL: tests/run installs it")
    assert run("revisitd", "migrate", "--store",
               database.url("revisit_owner")).returncode == 0
    log = tmp_path_factory.mktemp("shared") / "shared.log"
    with Server(database.url("revisit"), *ADMIN, *NAMED, log_path=log) as server:
        found |= scraped.scrape(server).kinds
    return found


def test_every_metric_of_dashboard_and_alerts_is_one_of_a_server(kinds):
    expressions = dashboard_expressions() + [rule[1] for rule in alerts()]
    assert len(expressions) > 50
    named = set().union(*map(metrics_of, expressions))
    assert named - set(kinds) == set()
    # And the dashboard shows all of them.
    shown = set().union(*map(metrics_of, dashboard_expressions()))
    assert set(kinds) - shown == set()


def test_every_metric_is_documented_with_its_type_and_unit(kinds):
    documented = {}
    for line in (ROOT / "docs/operate.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        for name in METRIC.findall(cells[0]) if len(cells) == 4 else []:
            assert name not in documented
            documented[name] = cells[1]
            assert cells[2], f"{name} has no unit"
    assert documented == kinds


def test_every_panel_says_what_it_shows_of_the_chosen_servers():
    panels = [panel for panel in json.loads(
        (MONITORING / "dashboard.json").read_text())["panels"]
        if panel["type"] != "row"]
    assert len(panels) > 30
    source = {"type": "prometheus", "uid": "${datasource}"}
    for panel in panels:
        title = panel["title"]
        assert title and panel["description"].endswith("."), title
        assert panel["fieldConfig"]["defaults"]["unit"], title
        for part in (panel, *panel["targets"]):
            assert part["datasource"] == source, title
        for target in panel["targets"]:
            expression = target["expr"]
            assert target["legendFormat"], expression
            selectors = re.findall(r"\b(?:up|(?:revisit|process)_[a-z_]+)(\{[^}]*\})?",
                                   expression)
            assert selectors, expression
            assert all('instance=~"$instance"' in selector
                       for selector in selectors), expression
            # Ranges follow the width of the screen.
            assert set(re.findall(r"\[([^]]*)\]", expression)) <= {
                "$__rate_interval"}, expression
            for name in re.findall(r"\b(\w+_(?:total|bucket))\{", expression):
                assert re.search(rf"\b(rate|increase)\({name}\{{", expression), (
                    expression)
            if "histogram_quantile" in expression:
                assert "by (le" in expression, expression


def test_names_end_with_their_units(kinds):
    for name, kind in kinds.items():
        assert (kind == "counter") == name.endswith("_total"), name
        assert not re.search(r"_(ms|millis|micros|kib|mib|percent)(_|$)",
                             name), name


def test_every_label_that_alerts_ask_for_is_one_of_a_server(secured):
    page = scraped.scrape(secured)
    values = {}
    for _, labels in page.samples:
        for label, value in labels:
            values.setdefault(label, set()).add(value)
    for name, expression, _ in alerts():
        for label, operator, pattern in re.findall(
                r'(\w+)(=~|=)"([^"]*)"', expression):
            if label == "job":
                continue
            for choice in pattern.split("|"):
                matching = [value for value in values[label]
                            if re.fullmatch(choice, value)]
                assert matching, f"{name}: {label}{operator}{choice}"


def test_every_alert_has_a_runbook_and_every_runbook_an_alert():
    text = (ROOT / "docs/runbooks.md").read_text()
    headings = re.findall(r"^## (.+)$", text, re.MULTILINE)
    assert headings == [name for name, _, _ in alerts()]
    for name, _, annotations in alerts():
        assert annotations["runbook_url"] == f"docs/runbooks.md#{name.lower()}"
        assert annotations["summary"]
    for section in re.split(r"^## .+$", text, flags=re.MULTILINE)[1:]:
        assert len(section.split()) > 25


def test_every_alert_has_a_test():
    text = (MONITORING / "alerts_test.yml").read_text()
    assert re.findall(r"^  - name: (\w+)$", text, re.MULTILINE) == [
        name for name, _, _ in alerts()]
    for test in re.split(r"^  - name: ", text, flags=re.MULTILINE)[1:]:
        # Silent first, then told, of every kind of harm that it is about.
        asked = test.split("- alertname: " + test.split()[0])[1:]
        assert [one.count("exp_alerts:") for one in asked] == [
            0, *[1] * (len(asked) - 1)] and len(asked) > 1


@needs_promtool
def test_promtool_accepts_rules_and_configuration_and_their_tests_pass():
    assert "SUCCESS" in promtool("check", "config",
                                 MONITORING / "prometheus.yml")
    assert "SUCCESS" in promtool("check", "rules", ALERTS)
    assert "SUCCESS" in promtool("test", "rules",
                                 MONITORING / "alerts_test.yml")


@needs_promtool
def test_promtool_accepts_the_expressions_of_the_dashboard(tmp_path):
    rules = [{"record": f"panel:{i}", "expr": expression
              .replace("$__rate_interval", "5m").replace("$instance", ".*")}
             for i, expression in enumerate(dashboard_expressions())]
    # JSON is YAML.
    path = tmp_path / "dashboard.yml"
    path.write_text(json.dumps({"groups": [{"name": "all", "rules": rules}]}))
    promtool("check", "rules", path)


@needs_promtool
def test_promtool_finds_no_fault_with_names_and_help(secured):
    text = scraped.scrape(secured).text
    result = subprocess.run([PROMTOOL, "check", "metrics"], input=text,
                            capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")


# ---- Prometheus itself

class Prometheus:
    """A real one with a configuration of ours, but for the addresses, and for its
    intervals, which are a second. Its files lie in `directory`."""

    def __init__(self, directory, configuration, targets):
        text = (ROOT / configuration).read_text()
        # Other jobs are of programs that do not run here.
        text = re.sub(r"  - job_name: (?!revisit\n).*\n(?: {4}.*\n)*", "", text)
        text, count = re.subn(r"targets: .*", f"targets: {json.dumps(targets)}", text)
        assert count == 1
        text = re.sub(r"_interval: .*", "_interval: 1s", text)
        (directory / "prometheus.yml").write_text(text)
        shutil.copy(ALERTS, directory)
        self.address = f"127.0.0.1:{free_port()}"
        self._log_path = directory / "prometheus.log"
        with open(self._log_path, "wb") as log:
            self.process = subprocess.Popen(
                [PROMETHEUS, f"--config.file={directory / 'prometheus.yml'}",
                 f"--storage.tsdb.path={directory / 'data'}",
                 f"--web.listen-address={self.address}"],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    def log(self):
        return self._log_path.read_text()

    def ask(self, path):
        """What the API answers, or None while it does not."""
        assert self.process.poll() is None, self.log()
        with contextlib.suppress(OSError):
            status, body, _ = scraped.get(self.address, f"/api/v1/{path}")
            if status == 200:
                return json.loads(body)["data"]

    def close(self):
        self.process.terminate()
        self.process.wait(30)


@pytest.mark.skipif(
    not os.access(PROMETHEUS, os.X_OK),
    reason="there is no Prometheus: tests/run takes it from Debian's package")
@pytest.mark.parametrize("configuration, count", [
    ("deploy/monitoring/prometheus.yml", 1), ("deploy/compose/prometheus.yml", 3)])
def test_prometheus_scrapes_the_servers_and_evaluates_every_alert(
        configuration, count, tmp_path):
    with contextlib.ExitStack() as stack:
        servers = [stack.enter_context(Server(tmp_path / f"store-{i}", *ADMIN))
                   for i in range(count)]
        prometheus = Prometheus(tmp_path, configuration,
                                [server.admin for server in servers])
        stack.callback(prometheus.close)

        def up():
            found = prometheus.ask("targets")
            targets = found["activeTargets"] if found else []
            return len(targets) == count and all(
                target["health"] == "up" for target in targets) and targets

        targets = wait_until(up, "scrape of every server")
        assert {target["labels"]["job"] for target in targets} == {"revisit"}

        def evaluated():
            groups = (prometheus.ask("rules") or {"groups": []})["groups"]
            rules = [rule for group in groups for rule in group["rules"]]
            return rules and all(
                rule["health"] != "unknown" for rule in rules) and rules

        rules = wait_until(evaluated, "evaluation of every alert")
        assert {rule["name"] for rule in rules} == {rule[0] for rule in alerts()}
        assert [rule for rule in rules if rule["health"] != "ok"] == []
        # Sound servers are told of by none, once the first scrape has shown them.
        wait_until(lambda: prometheus.ask("alerts") == {"alerts": []},
                   "end of what was pending")
        # And each panel has an expression that it takes.
        for expression in dashboard_expressions():
            expression = expression.replace("$__rate_interval", "5m").replace(
                "$instance", ".*")
            assert prometheus.ask(
                "query?" + urllib.parse.urlencode({"query": expression})) is not None


# ---- Alerts by what a real server answered

def assert_told(alert, quiet, pages, directory):
    """The alert is silent over `quiet`, scraped from a sound server, and is told
    over `pages`, scraped from one that came to harm: each as of a minute, the
    last one as long as it takes."""
    expression = next(rule[1] for rule in alerts() if rule[0] == alert)
    names = metrics_of(expression)
    # Prometheus' own time begins at 0 in its tests, and the pages' now.
    now = time.time()
    lasting = 15
    sequence = [quiet] * lasting + list(pages) + [pages[-1]] * lasting
    series = {}
    for minute, page in enumerate(sequence):
        for (name, labels), value in page.samples.items():
            if re.sub(r"_(bucket|count|sum)$", "", name) not in names:
                continue
            if "timestamp" in name:
                value -= now
            values = series.setdefault((name, labels), ["_"] * len(sequence))
            values[minute] = repr(value)
    assert series, names
    tested = {
        "rule_files": [str(ALERTS)], "evaluation_interval": "1m",
        "tests": [{
            "interval": "1m",
            "input_series": [{
                "series": name + "{" + ",".join(
                    f'{label}="{value}"' for label, value in
                    [*sorted(labels), ("instance", "a"), ("job", "revisit")])
                + "}", "values": " ".join(values)}
                for (name, labels), values in series.items()],
            "promql_expr_test": [{
                "expr": 'count(max_over_time(ALERTS{alertname="%s",'
                        'alertstate="firing"}[%dm]) > 0) > bool 0'
                        % (alert, lasting + len(pages)),
                "eval_time": f"{minute}m",
                "exp_samples": told} for minute, told in [
                    (lasting - 1, []),
                    (len(sequence) - 1, [{"labels": "{}", "value": 1}])]]}]}
    path = directory / f"{alert}.yml"
    path.write_text(json.dumps(tested))
    promtool("test", "rules", path)


def serve(directory, *flags, **environment):
    if environment:
        shim = BIN / "fault_shim.so"
        if not shim.exists():
            pytest.skip("fault_shim.so is not built")
        environment["LD_PRELOAD"] = str(shim)
    return Server(directory / "store", *ADMIN, *flags,
                  env=clean_environment(**environment))


def create(stub, name):
    stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id=name))
    return f"vehicles/{name}"


@needs_promtool
@pytest.mark.release_build
def test_full_disk_is_told(tmp_path):
    with serve(tmp_path, REVISIT_TEST_FAIL_WRITE="500",
               REVISIT_TEST_STICKY="1") as server:
        stub = server.stub()
        vehicle = create(stub, "truck")
        quiet = scraped.scrape(server)
        poses = iter(range(1, 100_000, 16))

        def full():
            try:
                append(stub, vehicle, straight(16, first=next(poses)))
            except Exception as error:
                assert error.code().name == "RESOURCE_EXHAUSTED"
                return True
            return False

        wait_until(full, "full disk")
        assert_told("RevisitWritesRefused", quiet, [scraped.scrape(server)],
                    tmp_path)


@needs_promtool
@pytest.mark.release_build
def test_slow_flushes_are_told(tmp_path):
    with serve(tmp_path, REVISIT_TEST_SLOW_SYNC="300000") as server:
        stub = server.stub()
        quiet = scraped.scrape(server)
        pages = []
        for number in range(12):
            create(stub, f"truck-{number}")
            pages.append(scraped.scrape(server))
        assert_told("RevisitFlushSlow", quiet, pages, tmp_path)


@pytest.fixture(name="shared")
def server_of_a_database(tmp_path):
    """A database, and a server that has its store there."""
    with own_postgres() as database:
        if database is None:
            pytest.skip("there is no PostgreSQL: tests/run installs it")
        assert run("revisitd", "migrate", "--store",
                   database.url("revisit_owner")).returncode == 0
        with Server(database.url("revisit"), *ADMIN, *NAMED,
                    "--lease-seconds", 1, log_path=tmp_path / "log") as server:
            yield database, server


@needs_promtool
@pytest.mark.release_build
def test_slow_commits_of_a_database_are_told(shared, tmp_path):
    database, server = shared
    quiet = scraped.scrape(server)
    # Each commit that touches the row of a server waits, as for a disk.
    database.ask("""
        CREATE FUNCTION wait() RETURNS trigger LANGUAGE plpgsql AS
        'BEGIN PERFORM pg_sleep(0.3); RETURN NULL; END';
        CREATE CONSTRAINT TRIGGER slow AFTER UPDATE ON servers
        DEFERRABLE INITIALLY DEFERRED FOR EACH ROW
        EXECUTE FUNCTION wait();""")
    pages = [quiet]
    while len(pages) < 12:
        pages.append(wait_until(
            lambda: more_flushes(server, pages[-1]), "commit"))
    assert_told("RevisitFlushSlow", quiet, pages[1:], tmp_path)


def more_flushes(server, before):
    page = scraped.scrape(server)
    name = "revisit_store_flush_seconds_count"
    return page.value(name) > before.value(name) and page


@needs_promtool
@pytest.mark.release_build
def test_store_that_failed_is_told_by_the_next_server(tmp_path):
    """The process was gone before anybody scraped it."""
    with serve(tmp_path) as server:
        quiet = scraped.scrape(server)
    with serve(tmp_path, REVISIT_TEST_FAIL_SYNC="60",
               REVISIT_TEST_STICKY="1") as server:
        stub = server.stub()
        vehicle = create(stub, "truck")

        def failed():
            try:
                append(stub, vehicle, straight(1, first=next(poses)))
            except Exception as error:
                assert error.code().name == "UNAVAILABLE"
                return True
            return False

        poses = iter(range(1, 1000))
        wait_until(failed, "failed flush")
        assert server.process.wait(30) == 74, server.log()
    with serve(tmp_path) as server:
        assert get_last_exit(server) == "store_failed"
        assert_told("RevisitStoreFailed", quiet, [scraped.scrape(server)], tmp_path)


def get_last_exit(server):
    """The reason that the metric gives; None if it gives none."""
    reasons = [dict(labels)["reason"] for labels, value in scraped.scrape(
        server).series("revisit_last_exit").items() if value]
    assert len(reasons) <= 1
    return reasons[0] if reasons else None


def test_each_end_of_a_server_is_told_by_the_next(tmp_path):
    def ended():
        """When it did, if that is known."""
        return scraped.scrape(server).value("revisit_last_exit_timestamp_seconds")

    begin = int(time.time())
    with serve(tmp_path) as server:
        assert (get_last_exit(server), ended()) == (None, 0)
    with serve(tmp_path) as server:
        assert get_last_exit(server) == "stopped"
        assert begin <= ended() <= time.time()
        server.kill()
    with serve(tmp_path) as server:
        assert (get_last_exit(server), ended()) == ("killed", 0)
        # One that cannot have the store changes nothing.
        assert run("revisitd", "--store", tmp_path / "store").returncode == 73
        assert get_last_exit(server) == "killed"
    (tmp_path / "store/revisit.sqlite.exit").write_text("something else")
    with serve(tmp_path) as server:
        assert (get_last_exit(server), ended()) == (None, 0)
    with serve(tmp_path) as server:
        assert get_last_exit(server) == "stopped"


@needs_promtool
def test_damaged_vehicle_is_told_while_nobody_asks_for_it(tmp_path):
    with serve(tmp_path) as server:
        append(server.stub(), create(server.stub(), "truck"), straight(9))
        quiet = wait_until(lambda: counted(server, "active"), "count")
    database = sqlite3.connect(tmp_path / "store/revisit.sqlite")
    with database:
        database.execute("UPDATE batches SET checksum = checksum + 1")
    database.close()
    with serve(tmp_path) as server:
        server.stub().GetVehicle(api.GetVehicleRequest(name="vehicles/truck"))
    with serve(tmp_path) as server:
        page = wait_until(lambda: counted(server, "damaged"), "count")
        assert page.value("revisit_resident_vehicles") == 0
        assert_told("RevisitDataDamaged", quiet, [page], tmp_path)


def counted(server, state):
    page = scraped.scrape(server)
    return page.value("revisit_vehicles", state=state) == 1 and page


@needs_promtool
def test_certificate_near_its_end_is_told(secured, tmp_path):
    page = scraped.scrape(secured)
    renewed = scraped.parse(page.text)
    for key in renewed.samples:
        if key[0] == "revisit_tls_certificate_expiry_timestamp_seconds":
            renewed.samples[key] += 27 * 86400
    assert_told("RevisitCertificateExpires", renewed, [page], tmp_path)


@needs_promtool
def test_search_overload_is_told(tmp_path):
    with serve(tmp_path, "--max-searches", 1, "--search-threads",
               1) as server:
        stub = server.stub()
        vehicle = create(stub, "truck")
        poses = laps(3000)
        for first in range(0, len(poses), 1000):
            append(stub, vehicle, poses[first:first + 1000])
        quiet = scraped.scrape(server)
        over = threading.Event()

        def search():
            while not over.is_set():
                try:
                    stub.FindCandidates(
                        api.FindCandidatesRequest(vehicle=vehicle))
                except Exception as error:
                    assert error.code().name == "UNAVAILABLE"

        searchers = [threading.Thread(target=search) for _ in range(4)]
        for thread in searchers:
            thread.start()
        pages = []
        try:
            while len(pages) < 12:
                before = (pages or [quiet])[-1]
                pages.append(wait_until(
                    lambda before=before: more_refusals(server, before),
                    "refusal"))
        finally:
            over.set()
            for thread in searchers:
                thread.join()
        assert_told("RevisitSearchesOverloaded", quiet, pages, tmp_path)


def more_refusals(server, before):
    page = scraped.scrape(server)
    name = "revisit_limit_refusals_total"
    return page.total(name) > before.total(name) and page


# The gauge stayed 1 where /readyz said 503, since each asked the store in its own way.
@needs_promtool
def test_database_that_is_dead_is_told_as_refused_writes(shared, tmp_path):
    database, server = shared

    def answers():
        """What the server says of writes, by its two ways."""
        return (scraped.get(server.admin, "/readyz")[:2],
                scraped.scrape(server).value("revisit_store_writable"))

    quiet = scraped.scrape(server)
    assert answers() == ((200, "ready\n"), 1)
    database.process.stop()
    wait_until(lambda: answers()[0][0] == 503, "end of the lease")
    (_, why), writable = answers()
    assert why.startswith("not writable: this server has not reached the database")
    assert writable == 0
    refused = scraped.scrape(server)
    server.logged("writes_refused")
    database.start()
    wait_until(lambda: answers() == ((200, "ready\n"), 1), "new lease")
    assert_told("RevisitWritesRefused", quiet, [refused], tmp_path)


@needs_promtool
def test_lost_lease_is_told(shared, tmp_path):
    database, server = shared
    stub = server.stub()
    append(stub, create(stub, "truck"), straight(3))
    quiet = scraped.scrape(server)
    assert quiet.value("revisit_store_owned_vehicles") == 1
    assert scraped.get(server.admin, "/readyz")[0] == 200
    database.process.kill()
    wait_until(lambda: scraped.scrape(server).value(
        "revisit_store_lease_held") == 0, "end of the lease")
    assert scraped.get(server.admin, "/readyz")[0] == 503
    assert scraped.get(server.admin, "/livez")[0] == 200
    assert_told("RevisitLeaseLost", quiet,
                [scraped.scrape(server)], tmp_path)
    server.kill()
