"""deploy/chart in a Kubernetes: its API server takes what the chart makes, and its node
runs the servers. Nothing here enforces the network policy, which is up to the network
of a cluster."""

import contextlib
import itertools
import json
import os
import pathlib
import re
import threading
import urllib.error
import urllib.request

import pytest
import yaml

from kubernetes_cluster import (BIN, ENVIRONMENT, NODE, TOOLS, Cluster,
                                RefusedError, run, wait_until)
from private_cluster import Processes
from test_chart import (CHART, CLUSTER, GUARDED, OPEN, OPERATE, ROOT, WAYS, documented,
                        flags)

if "REVISIT_CLUSTER_CGROUP" not in os.environ:
    pytest.skip("tests/orchestration/run --cluster starts a Kubernetes",
                allow_module_level=True)

DRIVE = ROOT / "tests/data/boreas/boreas_glen_shields.csv"
SERVERS = "app.kubernetes.io/component=server"
# Values below the chart's own: four servers fit onto two cores, and stop sooner.
SMALL = {"resources.requests.cpu": "100m", "drainNoticeSeconds": "2",
         "drainTimeoutSeconds": "3"}
VOLUMES = pathlib.Path("/run/kubernetes/volumes")
NUMBERS = itertools.count(1)
PROMETHEUS = pathlib.Path(os.environ.get("REVISIT_TEST_PROMETHEUS",
                                         ROOT / "build/tools/prometheus"))


@pytest.fixture(scope="module")
def cluster():
    logs = ROOT / "build/kubernetes"
    with Processes(logs) as processes:
        try:
            started = Cluster(processes, pathlib.Path("/run/kubernetes"),
                              os.environ["REVISIT_CLUSTER_CGROUP"])
            add_kinds(started)
        except BaseException:
            for log in sorted(logs.glob("*.log")):
                print(f"{log}:\n{log.read_text(errors='replace')[-2000:]}")
            raise
        yield started


def add_kinds(cluster):
    """Defines kinds as Prometheus' operator does."""
    path = "/apis/apiextensions.k8s.io/v1/customresourcedefinitions"

    def is_established(kind):
        status = cluster.ask(
            "GET", f"{path}/{kind}.monitoring.coreos.com")["status"]
        return any(entry["type"] == "Established" and entry["status"] == "True"
                   for entry in status["conditions"] or ())

    for file in sorted((TOOLS / "kubernetes/kinds").glob("*.yaml")):
        cluster.ask("POST", path, yaml.safe_load(file.read_text()))
        wait_until(lambda file=file: is_established(file.stem), file.stem)


class Namespace:
    """A namespace in which only pods may run that Kubernetes calls restricted."""

    def __init__(self, cluster, name):
        self.cluster = cluster
        self.name = name
        cluster.ask("POST", "/api/v1/namespaces", {"metadata": {
            "name": name, "labels": {
                f"pod-security.kubernetes.io/{mode}": "restricted"
                for mode in ("enforce", "warn")}}})

    def path(self, kind, name=""):
        group = {"statefulsets": "apis/apps/v1", "deployments": "apis/apps/v1",
                 "jobs": "apis/batch/v1",
                 "servicemonitors": "apis/monitoring.coreos.com/v1",
                 "prometheusrules": "apis/monitoring.coreos.com/v1",
                 }.get(kind, "api/v1")
        return f"/{group}/namespaces/{self.name}/{kind}/{name}".rstrip("/")

    def get(self, kind, name):
        return self.cluster.ask("GET", self.path(kind, name))

    def add(self, kind, body):
        return self.cluster.ask("POST", self.path(kind), body)

    def helm(self, command, values, *arguments, release="fleet"):
        return self.cluster.helm(command, release, CHART, "--namespace", self.name,
                                 *flags(values), *arguments)

    def install(self, values, *arguments, **more):
        said = self.helm("install", values, *arguments, **more)
        assert (said.returncode, said.stderr) == (0, ""), self.explain(said)

    def upgrade(self, values, *arguments, **more):
        """Keeps the values of before, but for these."""
        said = self.helm("upgrade", values, "--reuse-values", *arguments, **more)
        assert (said.returncode, said.stderr) == (0, ""), self.explain(said)

    def explain(self, said):
        """Helm's output and the events of the namespace, to be read after a failure."""
        events = self.cluster.ask("GET", self.path("events"))["items"]
        return "\n".join([said.stdout, said.stderr, *(
            f"{event['involvedObject']['name']}: {event['message']}"
            for event in events)])

    def pods(self):
        """The pods of servers, except those that were told to stop."""
        pods = self.cluster.ask(
            "GET", f"{self.path('pods')}?labelSelector={SERVERS}")["items"]
        return [pod for pod in pods if "deletionTimestamp" not in pod["metadata"]]

    def addresses(self, service, kind="addresses"):
        """The addresses of the pods that a service leads to."""
        return {entry["ip"] for subset in self.get("endpoints", service).get(
            "subsets", ()) for entry in subset.get(kind, ())}

    def host(self):
        """The name that a cluster's DNS would give the service; here /etc/hosts
        does."""
        host = f"fleet.{self.name}.svc"
        self.cluster.add_host(
            host, self.get("services", "fleet")["spec"]["clusterIP"])
        return host

    def revisit(self, *arguments):
        """Runs `revisit` beside the pods, through the service."""
        return run(BIN / "revisit", *arguments, "--server", f"{self.host()}:50051")

    def add_volume(self, name, storage_class=""):
        """Makes a folder of the node the volume that the single server gets."""
        folder = VOLUMES / name
        folder.mkdir(parents=True)
        self.cluster.ask("POST", "/api/v1/persistentvolumes", {
            "metadata": {"name": name}, "spec": {
                "storageClassName": storage_class,
                "capacity": {"storage": "20Gi"}, "accessModes": ["ReadWriteOnce"],
                "local": {"path": str(folder)},
                "claimRef": {"namespace": self.name, "name": "store-fleet-0"},
                "nodeAffinity": {"required": {"nodeSelectorTerms": [{
                    "matchExpressions": [{"key": "kubernetes.io/hostname",
                                          "operator": "In", "values": ["node"]}]}]}}}})

    def add_database(self):
        """Makes the secret of PostgreSQL's URLs; returns that PostgreSQL."""
        postgres = self.cluster.postgres()
        self.add("secrets", {"metadata": {"name": "database"}, "stringData": {
            "url": f"postgresql://revisit@{NODE}/revisit",
            "owner-url": f"postgresql://revisit_owner@{NODE}/revisit"}})
        return postgres

    def remove(self):
        releases = json.loads(self.cluster.helm(
            "list", "--all", "--short", "--output", "json", "--namespace",
            self.name).stdout)
        for release in releases:
            self.cluster.helm("uninstall", release, "--namespace", self.name)
        self.cluster.ask("DELETE", f"/api/v1/namespaces/{self.name}")


@pytest.fixture
def maps(cluster):
    """A namespace of the test's own."""
    namespace = Namespace(cluster, f"maps-{next(NUMBERS)}")
    yield namespace
    namespace.remove()


def workload(namespace, name="fleet"):
    """The StatefulSet or the Deployment of a release."""
    for kind in ("statefulsets", "deployments"):
        with contextlib.suppress(RefusedError):
            return namespace.get(kind, name)
    return None


def has_its_pods(namespace, name="fleet"):
    made = workload(namespace, name)
    return (made["metadata"]["generation"]
            == made["status"].get("observedGeneration")
            and made["status"].get("replicas", 0) >= made["spec"]["replicas"]
            and made["status"].get("updatedReplicas", 0) > 0)


@pytest.mark.parametrize("values", WAYS.values(), ids=WAYS)
def test_api_server_lets_it_in_without_a_warning(maps, values):
    # The hook is a job that needs a database; tests below have one.
    maps.install(values, "--no-hooks")
    # Pods that are not restricted are refused only when their controller makes them.
    wait_until(lambda: has_its_pods(maps), "pods")


@pytest.mark.parametrize(("release", "name"), [
    ("fleet.north", "fleet-north"), ("2nd", "revisit-2nd"),
    ("a" * 53, "a" * 52)], ids=["dots", "digit", "long"])
def test_release_may_have_any_name_that_helm_takes(maps, release, name):
    maps.install(OPEN, release=release)
    wait_until(lambda: has_its_pods(maps, name), "pods")
    assert maps.get("services", f"{name}-servers")["spec"]["clusterIP"] == "None"


UPGRADES = {
    "image": {"image.tag": "next"},
    "settings": {"settings.max-streams": "5"},
    "resources": {"resources.limits.memory": "3Gi"},
    "ports": {"adminPort": "9000", "service.port": "443"},
    "service": {"service.type": "NodePort"},
    "labels": {"podLabels.team": "mapping", "podAnnotations.a": "b"},
    "scheduling": {"nodeSelector.disk": "ssd", "tolerations[0].operator": "Exists"},
    "guard": {**GUARDED, "insecureAllowRemote": "false"},
    "monitoring": {"serviceMonitor.enabled": "true", "serviceMonitor.interval": "5s",
                   "prometheusRule.enabled": "true", "dashboard.enabled": "true"},
    "no policy": {"networkPolicy.enabled": "false"},
    "budget": {"podDisruptionBudget.maxUnavailable": "50%"},
    "servers": {"store.postgresql.replicas": "5"},
}


@pytest.mark.parametrize("values", [OPEN, CLUSTER], ids=["alone", "cluster"])
def test_values_may_change_in_an_upgrade(maps, values):
    maps.install(values, "--no-hooks")
    for change in UPGRADES.values():
        maps.upgrade(change, "--no-hooks")
    made = workload(maps)["spec"]
    assert made["replicas"] == (5 if values is CLUSTER else 1)
    assert made["template"]["spec"]["containers"][0]["image"].endswith(":next")
    wait_until(lambda: has_its_pods(maps), "pods")


@pytest.mark.parametrize("change", [
    {"store.sqlite.size": "30Gi"}, {"store.sqlite.storageClassName": "fast"}],
    ids=["size", "class"])
def test_volume_of_a_server_may_not_change_in_an_upgrade(maps, change):
    maps.install(OPEN)
    said = maps.helm("upgrade", change, "--reuse-values")
    assert said.returncode != 0
    assert "Forbidden: updates to statefulset spec" in said.stderr


def stream(namespace, vehicle):
    """Streams a drive of 2076 poses into a new vehicle."""
    namespace.revisit("stream", DRIVE, "--uncertainty", "file", "--vehicle", vehicle,
                      "--create")


def poses(namespace, vehicle):
    """The number of its durable poses."""
    [number] = re.findall(r"^durable poses +(\d+)$", namespace.revisit(
        "vehicle", "get", vehicle), re.MULTILINE)
    return int(number)


def test_server_of_a_volume_has_its_poses_after_upgrades(maps):
    maps.cluster.ask("POST", "/apis/storage.k8s.io/v1/storageclasses", {
        "metadata": {"name": "growing"}, "allowVolumeExpansion": True,
        "provisioner": "kubernetes.io/no-provisioner"})
    maps.add_volume("kept", "growing")
    values = {**OPEN, **SMALL, "store.sqlite.storageClassName": "growing"}
    maps.install(values, "--wait", "--timeout", "60s")
    stream(maps, "shuttle-7")
    assert poses(maps, "shuttle-7") == 2076

    maps.upgrade({"image.tag": "next"}, "--wait", "--timeout", "60s")
    [pod] = maps.pods()
    assert pod["spec"]["containers"][0]["image"] == "localhost/revisit:next"
    assert poses(maps, "shuttle-7") == 2076

    # A larger volume, as documented. The kind of storage that there is here takes the
    # claim, and does not grow.
    [claim] = re.findall(r"^kubectl patch pvc store-fleet-0 --patch +'(.*)'$",
                         OPERATE, re.MULTILINE)
    maps.cluster.ask("PATCH", maps.path("persistentvolumeclaims", "store-fleet-0"),
                     json.loads(claim), kind="application/strategic-merge-patch+json")
    assert "kubectl delete statefulset fleet --cascade=orphan\n" in OPERATE
    maps.cluster.ask("DELETE", maps.path("statefulsets", "fleet"),
                     {"propagationPolicy": "Orphan"})
    wait_until(lambda: workload(maps) is None, "end of the StatefulSet")
    _, larger = documented("helm upgrade")
    maps.upgrade({}, *larger, "--wait", "--timeout", "60s")
    assert workload(maps)["spec"]["volumeClaimTemplates"][0]["spec"]["resources"][
        "requests"]["storage"] == "40Gi"
    [kept] = maps.pods()
    assert kept["metadata"]["uid"] == pod["metadata"]["uid"]
    assert poses(maps, "shuttle-7") == 2076

    maps.cluster.helm("uninstall", "fleet", "--namespace", maps.name, "--wait")
    maps.install(values, "--wait", "--timeout", "60s")
    assert poses(maps, "shuttle-7") == 2076


def answer(pod, path):
    """The HTTP status with which a pod's administrative port answers, or None if it
    does not answer: a pod runs before its server listens."""
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(f"http://{pod['status']['podIP']}:9464{path}") as said:
            return said.status
    except urllib.error.HTTPError as error:
        return error.code
    except urllib.error.URLError:
        return None


def test_server_that_takes_no_writes_leaves_the_service_and_is_not_restarted(maps):
    maps.add_volume("full")
    maps.install({**OPEN, **SMALL, "settings.min-free-bytes": str(10**15)})
    wait_until(lambda: maps.addresses("fleet", "notReadyAddresses"),
               "server that is not ready")
    [pod] = maps.pods()
    [container] = pod["spec"]["containers"]
    path = {probe: container[f"{probe}Probe"]["httpGet"]["path"]
            for probe in ("liveness", "readiness")}
    wait_until(lambda: answer(pod, path["liveness"]) == 200, "server that is alive")
    assert answer(pod, path["readiness"]) == 503
    [state] = maps.pods()[0]["status"]["containerStatuses"]
    assert "running" in state["state"] and state["restartCount"] == 0
    assert not maps.addresses("fleet")
    assert maps.addresses("fleet-servers") == {pod["status"]["podIP"]}

    # An upgrade replaces it although it never was ready.
    maps.upgrade({"settings.min-free-bytes": "1000000"}, "--wait", "--timeout", "60s")
    assert maps.addresses("fleet")


class Watch:
    """Looks at a service and its pods, and streams one drive after the other, while
    something happens."""

    def __init__(self, namespace):
        self._namespace = namespace
        self._end = threading.Event()
        self._threads = [threading.Thread(target=self._repeat, args=[step])
                         for step in (self._look, self._drive)]
        self.ready = set()
        self.pods = set()
        self.vehicles = []
        self.failures = []

    def _repeat(self, step):
        while not self._end.wait(0.1):
            try:
                step()
            except Exception as error:  # Whatever it is, the test has to know.
                self.failures.append(error)

    def _look(self):
        self.ready.add(len(self._namespace.addresses("fleet")))
        self.pods.add(len(self._namespace.pods()))

    def _drive(self):
        vehicle = f"van-{len(self.vehicles)}"
        self.vehicles.append(vehicle)
        stream(self._namespace, vehicle)

    def __enter__(self):
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_):
        self._end.set()
        for thread in self._threads:
            thread.join()


def test_servers_of_one_database_are_replaced_one_by_one_without_a_gap(maps):
    postgres = maps.add_database()
    maps.install({**CLUSTER, **SMALL}, "--wait", "--timeout", "90s")
    assert len(maps.addresses("fleet")) == 3
    # The job of the installation made the tables.
    assert postgres.ask("SELECT count(*) FROM pg_tables WHERE schemaname = 'public'"
                        ) != "0"
    stream(maps, "shuttle-8")

    before = {pod["metadata"]["uid"] for pod in maps.pods()}
    with Watch(maps) as watch:
        maps.upgrade({"image.tag": "next"}, "--wait", "--timeout", "120s")
    after = maps.pods()
    assert len(after) == 3
    assert not before & {pod["metadata"]["uid"] for pod in after}
    assert min(watch.ready) >= 3
    assert max(watch.pods) == 4
    assert not watch.failures
    assert len(watch.vehicles) > 3
    for vehicle in ("shuttle-8", *watch.vehicles):
        assert poses(maps, vehicle) == 2076

    # Nodes are drained one server at a time.
    def evict(pod):
        name = pod["metadata"]["name"]
        maps.cluster.ask("POST", f"{maps.path('pods', name)}/eviction", {
            "apiVersion": "policy/v1", "kind": "Eviction",
            "metadata": {"name": name, "namespace": maps.name}})

    first, second, _ = after
    evict(first)
    with pytest.raises(RefusedError, match="disruption budget") as refused:
        evict(second)
    assert refused.value.code == 429
    wait_until(lambda: len(maps.addresses("fleet")) == 3, "three servers")
    evict(second)


def openssl(folder, *arguments):
    run("openssl", *arguments, cwd=folder)


def make_certificates(folder, host):
    """An authority, and certificates of the servers and of a client."""
    key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-noenc")
    openssl(folder, "req", "-x509", *key, "-keyout", "ca.key", "-out", "ca.crt",
            "-days", "2", "-subj", "/CN=fleet")
    for name, alternative in (("tls", f"DNS:{host}"), ("client", "DNS:operator")):
        (folder / "extensions").write_text(f"subjectAltName={alternative}\n")
        openssl(folder, "req", *key, "-keyout", f"{name}.key", "-out",
                f"{name}.request", "-subj", f"/CN={name}")
        openssl(folder, "x509", "-req", "-in", f"{name}.request", "-CA", "ca.crt",
                "-CAkey", "ca.key", "-CAcreateserial", "-days", "2", "-extfile",
                "extensions", "-out", f"{name}.crt")


def test_documented_commands_start_one_server_and_then_several(maps, tmp_path):
    make_certificates(tmp_path, f"fleet.{maps.name}.svc")
    read = {name: (tmp_path / name).read_text()
            for name in ("ca.crt", "tls.crt", "tls.key")}
    maps.add("secrets", {"metadata": {"name": "certificate"},
                         "type": "kubernetes.io/tls", "stringData": {
                             name: read[name] for name in ("tls.crt", "tls.key")}})
    maps.add("secrets", {"metadata": {"name": "vehicles"},
                         "stringData": {"ca.crt": read["ca.crt"]}})
    maps.add("configmaps", {"metadata": {"name": "policy"}, "data": {
        "policy.json": json.dumps({"version": 1, "tenants": [], "grants": [
            {"certificate_dns": "operator", "tenant": "*", "vehicles": ["*"],
             "verbs": ["read", "write", "admin"]}]})}})
    maps.add_volume("documented")
    [installed] = documented("helm install")
    several, _ = documented("helm upgrade")
    maps.install({}, *installed, "--wait", "--timeout", "60s")
    assert workload(maps)["kind"] == "StatefulSet"
    # A client with its certificate gets in, and nobody without one.
    authority = ("--tls-ca", tmp_path / "ca.crt")
    operator = (*authority, "--tls-cert", tmp_path / "client.crt", "--tls-key",
                tmp_path / "client.key")
    maps.revisit("vehicle", "create", "shuttle-9", *operator)
    with pytest.raises(AssertionError, match="UNAVAILABLE"):
        maps.revisit("info", *authority)

    maps.add_database()
    maps.upgrade({}, *several, "--wait", "--timeout", "90s")
    assert workload(maps)["kind"] == "Deployment"
    wait_until(lambda: len(maps.addresses("fleet")) == 3, "three servers")
    maps.revisit("vehicle", "create", "shuttle-10", *operator)


# ---- A Prometheus that does as the chart's objects say

# Longer than an alert waits before it is told.
ALERT_SECONDS = 180


def label(name):
    """The label in which Prometheus has one of a service."""
    return "__meta_kubernetes_service_label_" + re.sub(r"\W", "_", name)


def scrape_config(monitor):
    """What Prometheus' operator makes of a ServiceMonitor that has only these fields,
    but that the addresses come from a file: Debian's Prometheus does not ask
    Kubernetes."""
    spec, meta = monitor["spec"], monitor["metadata"]
    [endpoint] = spec["endpoints"]
    assert spec.keys() == {"jobLabel", "selector", "endpoints"}
    assert spec["selector"].keys() == {"matchLabels"}
    assert endpoint.keys() == {"port", "path", "interval"}
    kept = {"__meta_kubernetes_endpoint_port_name": endpoint["port"], **{
        label(name): value
        for name, value in spec["selector"]["matchLabels"].items()}}
    copied = {"namespace": "__meta_kubernetes_namespace",
              "pod": "__meta_kubernetes_pod_name",
              "job": "__meta_kubernetes_service_name"}
    return {
        "job_name": f"serviceMonitor/{meta['namespace']}/{meta['name']}/0",
        "metrics_path": endpoint["path"],
        "scrape_interval": endpoint["interval"],
        "scrape_timeout": endpoint["interval"],
        "file_sd_configs": [{"files": ["endpoints.json"]}],
        "relabel_configs": [
            *({"action": "keep", "source_labels": [name],
               "regex": re.escape(value)} for name, value in kept.items()),
            *({"source_labels": [name], "target_label": made}
              for made, name in copied.items()),
            {"source_labels": [label(spec["jobLabel"])], "regex": "(.+)",
             "target_label": "job"}]}


def endpoints(namespace):
    """Every address of every service, as Prometheus would have it from Kubernetes."""
    found = namespace.cluster.ask("GET", namespace.path("endpoints"))["items"]
    return [
        {"targets": [f"{address['ip']}:{port['port']}"],
         "labels": {
             "__meta_kubernetes_namespace": namespace.name,
             "__meta_kubernetes_service_name": one["metadata"]["name"],
             "__meta_kubernetes_endpoint_port_name": port["name"],
             "__meta_kubernetes_pod_name": address["targetRef"]["name"],
             **{label(name): value
                for name, value in one["metadata"].get("labels", {}).items()}}}
        for one in found for subset in one.get("subsets", ())
        for port in subset["ports"] for address in (
            *subset.get("addresses", ()), *subset.get("notReadyAddresses", ()))]


class Prometheus:
    """A real one beside the pods, with the ServiceMonitor and the PrometheusRule that
    the API server has of a namespace. A context manager that stops it."""

    def __init__(self, namespace):
        self._namespace = namespace
        self._address = f"{NODE}:9090"

    def _only(self, kind):
        [found] = self._namespace.cluster.ask(
            "GET", self._namespace.path(kind))["items"]
        return found

    def __enter__(self):
        self._processes = Processes(ROOT / "build/kubernetes")
        directory = pathlib.Path("/run/kubernetes/prometheus")
        directory.mkdir()
        (directory / "alerts.yml").write_text(yaml.safe_dump(
            self._only("prometheusrules")["spec"]))
        (directory / "prometheus.yml").write_text(yaml.safe_dump({
            "global": {"evaluation_interval": "1s"}, "rule_files": ["alerts.yml"],
            "scrape_configs": [scrape_config(self._only("servicemonitors"))]}))
        self._endpoints = directory / "endpoints.json"
        self._write_endpoints()
        self._end = threading.Event()
        self._follower = threading.Thread(target=self._follow)
        self._follower.start()
        self._process = self._processes.start(
            "prometheus", PROMETHEUS, f"--config.file={directory}/prometheus.yml",
            f"--storage.tsdb.path={directory}/data",
            f"--web.listen-address={self._address}", env=ENVIRONMENT)
        return self

    def __exit__(self, *_):
        self._end.set()
        self._follower.join()
        self._processes.stop()

    def _follow(self):
        while not self._end.wait(0.5):
            # The API server may be busy: what is there stays until it answers.
            with contextlib.suppress(OSError, RefusedError):
                self._write_endpoints()

    def _write_endpoints(self):
        """At once, and with a name that Prometheus does not look for until then."""
        made = self._endpoints.with_suffix(".new")
        made.write_text(json.dumps(endpoints(self._namespace)))
        made.replace(self._endpoints)

    def _ask(self, path):
        self._process.check()
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        try:
            with opener.open(f"http://{self._address}/api/v1/{path}") as answer:
                return json.load(answer)["data"]
        except OSError:
            return None

    def targets(self):
        """The labels of what answers its scrapes."""
        found = self._ask("targets") or {"activeTargets": []}
        return [target["labels"] for target in found["activeTargets"]
                if target["health"] == "up"]

    def fires(self, alert, **labels):
        """Whether the alert is told, with these labels; None: without that label."""
        found = self._ask("alerts") or {"alerts": []}
        return any(
            one["state"] == "firing" and one["labels"]["alertname"] == alert
            and all(one["labels"].get(name) == value
                    for name, value in labels.items())
            for one in found["alerts"])


@pytest.mark.skipif(not os.access(PROMETHEUS, os.X_OK),
                    reason="there is no Prometheus: tests/run installs it")
def test_alerts_of_the_chart_are_told(maps):
    maps.add_volume("watched")
    maps.install({**OPEN, **SMALL, "serviceMonitor.enabled": "true",
                  "serviceMonitor.interval": "1s", "prometheusRule.enabled": "true"},
                 "--wait", "--timeout", "60s")
    with Prometheus(maps) as prometheus:
        def told(alert, **labels):
            wait_until(lambda: prometheus.fires(alert, **labels), alert,
                       ALERT_SECONDS)

        [target] = wait_until(prometheus.targets, "scrape")
        assert target["job"] == "revisit"
        instance = target["instance"]
        assert not any(prometheus.fires(alert) for alert in (
            "RevisitDown", "RevisitWritesRefused", "RevisitStoreFailed"))

        # The file of the store goes away under the server, and comes back.
        store = VOLUMES / "watched/store/revisit.sqlite"
        store.rename(f"{store}.aside")
        store.touch()
        with pytest.raises(AssertionError, match="UNAVAILABLE"):
            maps.revisit("vehicle", "create", "shuttle-7")
        wait_until(lambda: not prometheus.targets(), "end of the server")
        pathlib.Path(f"{store}.aside").rename(store)
        told("RevisitStoreFailed", job="revisit", instance=instance)

        maps.upgrade({"settings.min-free-bytes": str(10**15)})
        told("RevisitWritesRefused", job="revisit")

        # A server that never comes: there is no such image.
        maps.upgrade({"settings.min-free-bytes": "1000000", "image.tag": "none"})
        told("RevisitDown", job="revisit", pod="fleet-0")

        # And none at all.
        maps.cluster.helm("uninstall", "fleet", "--namespace", maps.name)
        told("RevisitDown", job="revisit", instance=None)
