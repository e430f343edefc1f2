"""deploy/chart: what Helm makes of it is valid, safe, and understood by revisitd."""

import json
import os
import pathlib
import re
import subprocess

import kubernetes_validate
import pytest
import yaml

ROOT = pathlib.Path(__file__).resolve().parents[2]
CHART = ROOT / "deploy/chart"
TOOLS = pathlib.Path(os.environ["REVISIT_TOOLS"])
BIN = pathlib.Path(os.environ["REVISIT_BIN"])
SCHEMAS = (pathlib.Path(kubernetes_validate.__file__).parent
           / "kubernetes-json-schema")

# Commands in one line each.
OPERATE = (ROOT / "docs/operate.md").read_text().replace("\\\n", "")

# The oldest version that the chart allows, and the newest that there are schemas of.
KUBERNETES = ("1.25.0", "1.37.0")

OPEN = {"insecureAllowRemote": "true"}
CLUSTER = {**OPEN, "store.kind": "postgresql",
           "store.postgresql.existingSecret": "database"}
GUARDED = {"tls.existingSecret": "certificate", "tls.clientCaSecret": "vehicles",
           "policy.existingConfigMap": "policy",
           "policy.tokenIssuer": "https://login.example",
           "policy.tokenAudience": "revisit"}
CONSOLE = {"console.enabled": "true"}
SIGN_IN = {"console.tlsCaSecret": "ca", "console.oidc.clientId": "console",
           "console.oidc.existingSecret": "client",
           "console.oidc.resource": "https://revisit.example",
           "console.publicUrl": "https://console.example"}
WAYS = {
    "alone": OPEN,
    "alone, guarded": GUARDED,
    "alone, other values": {
        **OPEN, "settings.max-streams": "5", "settings.max-batch-poses": "100",
        "store.sqlite.storageClassName": "fast", "image.tag": "edge",
        "nodeSelector.disk": "ssd", "tolerations[0].operator": "Exists",
        "imagePullSecrets[0].name": "registry", "podAnnotations.a": "b",
        "podLabels.team": "mapping", "serviceAccount.annotations.c": "d",
        "networkPolicy.clients[0].podSelector.matchLabels.role": "vehicle"},
    "cluster": CLUSTER,
    "cluster, guarded and watched": {
        **CLUSTER, **GUARDED, "insecureAllowRemote": "false",
        "serviceMonitor.enabled": "true",
        "serviceMonitor.labels.release": "prometheus",
        "prometheusRule.enabled": "true",
        "prometheusRule.labels.release": "prometheus",
        "dashboard.enabled": "true"},
    "alone, with a console": {**OPEN, **CONSOLE},
    "alone, guarded, with a console": {**GUARDED, **CONSOLE, **SIGN_IN},
    "cluster, with a console": {
        **CLUSTER, **CONSOLE, "console.server": "envoy.maps.svc:50051",
        "console.extraArgs[0]": "--max-metadata-bytes=16000"},
    "without a network policy": {**OPEN, "networkPolicy.enabled": "false"},
}


def helm(*arguments):
    return subprocess.run([TOOLS / "helm", *arguments], capture_output=True,
                          text=True, check=False)


def flags(values):
    return [word for name, value in values.items()
            for word in ("--set-string" if name.startswith("settings.") else
                         "--set", f"{name}={value}")]


def render(values, kubernetes=KUBERNETES[-1]):
    made = helm("template", "fleet", CHART, "--namespace", "maps",
                "--kube-version", kubernetes, *flags(values))
    assert made.returncode == 0, made.stderr
    return made.stdout


def objects(values):
    return {(one["kind"], one["metadata"]["name"]): one
            for one in yaml.safe_load_all(render(values)) if one}


def pods(values):
    """The templates of all pods."""
    return [one["spec"]["template"]["spec"] for one in objects(values).values()
            if one["kind"] in ("StatefulSet", "Deployment", "Job")]


def whole(schema, definitions):
    """A schema with what it refers to in its place: kubeconform does not follow
    references to other files."""
    if isinstance(schema, list):
        return [whole(one, definitions) for one in schema]
    if not isinstance(schema, dict):
        return schema
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return whole(definitions[name], definitions)
    return {name: whole(value, definitions) for name, value in schema.items()}


@pytest.fixture(scope="session", params=KUBERNETES)
def kubernetes(request, tmp_path_factory):
    """A version of Kubernetes, and its schemas of what the chart makes."""
    folder = SCHEMAS / f"v{request.param}-local-strict"
    definitions = json.loads((folder / "_definitions.json").read_text())["$defs"]
    made = tmp_path_factory.mktemp(request.param)
    for kind in ("configmap-v1", "service-v1", "serviceaccount-v1",
                 "statefulset-apps-v1", "deployment-apps-v1", "job-batch-v1",
                 "networkpolicy-networking-v1",
                 "poddisruptionbudget-policy-v1"):
        schema = json.loads((folder / f"{kind}.json").read_text())
        (made / f"{kind}.json").write_text(json.dumps(
            whole(schema, definitions)))
    return request.param, made


@pytest.mark.parametrize("values", WAYS.values(), ids=WAYS)
def test_linter_has_nothing_to_say(values):
    said = helm("lint", "--strict", CHART, *flags(values))
    assert said.returncode == 0, said.stdout


@pytest.mark.parametrize("values", WAYS.values(), ids=WAYS)
def test_kubernetes_knows_everything_that_is_made(values, kubernetes):
    version, schemas = kubernetes
    said = subprocess.run(
        [TOOLS / "kubeconform", "-strict", "-summary", "-output", "json",
         "-kubernetes-version", version, "-schema-location",
         f"{schemas}/{{{{.ResourceKind}}}}{{{{.KindSuffix}}}}.json",
         # Prometheus' operator defines them, not Kubernetes.
         "-skip", "ServiceMonitor,PrometheusRule", "-"], input=render(values, version),
        capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stdout + said.stderr
    summary = json.loads(said.stdout)["summary"]
    assert summary["valid"] >= 5
    assert summary["skipped"] == (2 if "serviceMonitor.enabled" in values else 0)


def test_kubernetes_would_refuse_what_is_misspelt(kubernetes):
    version, schemas = kubernetes
    said = subprocess.run(
        [TOOLS / "kubeconform", "-strict", "-kubernetes-version", version,
         "-schema-location",
         f"{schemas}/{{{{.ResourceKind}}}}{{{{.KindSuffix}}}}.json", "-"],
        input=render(OPEN, version).replace("readOnlyRootFilesystem", "readonly"),
        capture_output=True, text=True, check=False)
    assert said.returncode != 0


@pytest.mark.parametrize("values", WAYS.values(), ids=WAYS)
def test_server_takes_its_settings(values, tmp_path):
    file = tmp_path / "revisitd.conf"
    file.write_text(objects(values)["ConfigMap", "fleet"]["data"]["revisitd.conf"])
    said = subprocess.run(
        [BIN / "revisitd", "--config", file, "--print-config"],
        capture_output=True, text=True, check=False,
        env={"PATH": os.environ["PATH"]})
    assert said.returncode == 0, said.stderr
    assert 'admin-listen = "0.0.0.0:9464"' in said.stdout
    assert "drain-notice-seconds = 15" in said.stdout
    if "settings.max-streams" in values:
        assert "max-streams = 5\n" in said.stdout


def test_numbers_in_a_file_of_values_reach_the_server_in_full(tmp_path):
    """Helm reads them as floating point, and wrote 2e+09."""
    file = tmp_path / "values.yaml"
    file.write_text("settings: {max-memory-bytes: 2000000000, max-streams: 1000000, "
                    "stream-poses-per-second: 0.5, metrics: true}")
    made = helm("template", "fleet", CHART, "--kube-version", KUBERNETES[-1],
                "--values", file, *flags(OPEN))
    assert made.returncode == 0, made.stderr
    for line in ('max-memory-bytes = "2000000000"', 'max-streams = "1000000"',
                 'stream-poses-per-second = "0.5"', 'metrics = "true"'):
        assert f"{line}\n" in made.stdout


WATCHED = {**OPEN, "serviceMonitor.enabled": "true", "prometheusRule.enabled": "true",
           "dashboard.enabled": "true"}


def test_alerts_and_dashboard_are_those_of_the_tree():
    """Nothing of them is written a second time."""
    made = objects(WATCHED)
    alerts = (ROOT / "deploy/monitoring/alerts.yml").read_text()
    assert made["PrometheusRule", "fleet"]["spec"] == yaml.safe_load(alerts)
    dashboard = made["ConfigMap", "fleet-dashboard"]
    assert dashboard["data"] == {"revisit.json": (
        ROOT / "deploy/monitoring/dashboard.json").read_text()}
    assert dashboard["metadata"]["labels"]["grafana_dashboard"] == "1"


def test_servers_are_scraped_as_the_job_that_alerts_and_dashboard_ask_for():
    """The name of the service was the job, so the alert on a dead server was silent."""
    made = objects(WATCHED)
    [monitor] = [one for (kind, _), one in made.items() if kind == "ServiceMonitor"]
    wanted = monitor["spec"]["selector"]["matchLabels"].items()
    [service] = [one for (kind, _), one in made.items() if kind == "Service"
                 and wanted <= one["metadata"]["labels"].items()]
    job = service["metadata"]["labels"][monitor["spec"]["jobLabel"]]
    for name in ("alerts.yml", "dashboard.json"):
        asked = set(re.findall(r'job=\\?"([^"\\]*)', (
            ROOT / "deploy/monitoring" / name).read_text()))
        assert asked == {job}, name


def test_runbooks_lead_to_where_they_are_published():
    published = "https://docs.example/revisit/runbooks.html"
    made = objects({**WATCHED, "prometheusRule.runbooks": published})
    rules = [rule for group in made["PrometheusRule", "fleet"]["spec"]["groups"]
             for rule in group["rules"]]
    for rule in rules:
        assert rule["annotations"]["runbook_url"] == (
            f"{published}#{rule['alert'].lower()}")


@pytest.mark.parametrize("release", ["fleet.north", "2nd", "9" * 53])
def test_services_have_names_whatever_the_release_is_called(release):
    """Kubernetes let no release in whose name began with a digit or had a dot."""
    made = helm("template", release, CHART, "--kube-version", KUBERNETES[-1],
                *flags(OPEN))
    assert made.returncode == 0, made.stderr
    names = [one["metadata"]["name"] for one in yaml.safe_load_all(made.stdout)
             if one and one["kind"] == "Service"]
    assert len(names) == 2
    for name in names:
        assert re.fullmatch("[a-z]([-a-z0-9]{0,61}[a-z0-9])?", name)


@pytest.mark.parametrize("values", WAYS.values(), ids=WAYS)
def test_pods_are_restricted_as_kubernetes_calls_it(values):
    for pod in pods(values):
        assert pod["securityContext"]["runAsNonRoot"]
        assert pod["securityContext"]["runAsUser"] > 0
        assert pod["securityContext"]["seccompProfile"] == {
            "type": "RuntimeDefault"}
        assert not pod["automountServiceAccountToken"]
        for container in pod["containers"]:
            context = container["securityContext"]
            assert not context["allowPrivilegeEscalation"]
            assert context["readOnlyRootFilesystem"]
            assert context["capabilities"] == {"drop": ["ALL"]}


def console_args(values):
    [container] = objects(values)["Deployment", "fleet-console"]["spec"][
        "template"]["spec"]["containers"]
    return container["args"]


@pytest.mark.parametrize("values", [one for one in WAYS.values()
                                    if "console.enabled" in one],
                         ids=[name for name in WAYS if "console" in name])
def test_console_takes_its_options(values, tmp_path):
    """It starts with them, as far as their files are there."""
    files = {"/etc/revisit/servers-ca/ca.crt": tmp_path / "ca.crt",
             "/etc/revisit/client-secret/client-secret": tmp_path / "secret"}
    for file in files.values():
        file.write_text("")
    args = []
    for arg in console_args(values):
        for place, file in files.items():
            arg = arg.replace(place, str(file))
        args.append(re.sub(r"0\.0\.0\.0:\d+$", "127.0.0.1:0", arg))
    console = ROOT / "client/console/dist/server/main.js"
    with subprocess.Popen(["node", console, *args], stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE, text=True) as process:
        try:
            assert "admin listening" in process.stdout.readline()
            assert "The console is at" in process.stdout.readline()
        finally:
            process.terminate()


def test_console_signs_people_in_at_the_issuer_of_the_policy():
    args = console_args({**GUARDED, **CONSOLE, **SIGN_IN})
    assert "--oidc-issuer=https://login.example" in args
    assert "--public-url=https://console.example" in args
    assert "--server=fleet.maps.svc:50051" in args
    assert "--oidc-client-secret-file=/etc/revisit/client-secret/client-secret" \
        in args


def test_console_is_let_through_to_the_server():
    values = {**OPEN, **CONSOLE,
              "networkPolicy.clients[0].podSelector.matchLabels.role": "vehicle",
              "networkPolicy.monitoring[0].podSelector.matchLabels.role": "scraper"}
    made = objects(values)
    labels = made["Deployment", "fleet-console"]["spec"]["template"]["metadata"][
        "labels"].items()
    for rule in made["NetworkPolicy", "fleet"]["spec"]["ingress"]:
        assert [peer for peer in rule["from"]
                if peer["podSelector"]["matchLabels"].items() <= labels], rule
    # Without it nobody else is let in.
    rules = objects({**values, "console.enabled": "false"})[
        "NetworkPolicy", "fleet"]["spec"]["ingress"]
    assert [len(rule["from"]) for rule in rules] == [1, 1]


def documented(command):
    """The arguments of each such command of helm in docs/operate.md after the chart."""
    return [arguments.replace("--reuse-values", "").split() for arguments in re.findall(
        rf"^{command} fleet deploy/chart (.*)$", OPERATE, re.MULTILINE)]


def test_documented_commands_make_one_server_and_then_several():
    """As they are printed, but into no cluster."""
    def kinds(*arguments):
        made = helm("template", "fleet", CHART, "--kube-version",
                    KUBERNETES[-1], *arguments)
        assert made.returncode == 0, made.stderr
        return {one["kind"] for one in yaml.safe_load_all(made.stdout) if one}

    [installed] = documented("helm install")
    assert "StatefulSet" in kinds(*installed)
    several, _ = documented("helm upgrade")
    upgraded = kinds(*installed, *several)
    assert "Deployment" in upgraded and "StatefulSet" not in upgraded


def test_users_of_the_pods_are_those_of_the_images():
    made = pods({**OPEN, **CONSOLE})
    assert {pod["containers"][0]["name"] for pod in made} == set(
        images := {"revisitd": "Containerfile", "console": "Containerfile.console"})
    for pod in made:
        image = images[pod["containers"][0]["name"]]
        [user] = re.findall(r"^USER (\d+):\1$", (
            ROOT / "deploy/image" / image).read_text(), re.MULTILINE)
        assert str(pod["securityContext"]["runAsUser"]) == user
        assert str(pod["securityContext"]["fsGroup"]) == user


def test_store_in_a_file_has_one_server_whose_node_may_be_drained():
    made = objects(OPEN)
    server = made["StatefulSet", "fleet"]
    assert server["spec"]["replicas"] == 1
    [claim] = server["spec"]["volumeClaimTemplates"]
    assert claim["spec"]["resources"]["requests"]["storage"] == "20Gi"
    assert not [kind for kind, _ in made if kind == "PodDisruptionBudget"]
    # It calls nobody.
    assert made["NetworkPolicy", "fleet"]["spec"]["policyTypes"] == [
        "Ingress", "Egress"]


def test_servers_of_one_database_go_one_at_a_time_and_name_themselves():
    made = objects(CLUSTER)
    server = made["Deployment", "fleet"]["spec"]
    assert server["replicas"] == 3
    assert server["strategy"]["rollingUpdate"]["maxUnavailable"] == 0
    budget = made["PodDisruptionBudget", "fleet"]["spec"]
    assert budget["maxUnavailable"] == 1
    assert budget["selector"] == server["selector"]
    [container] = server["template"]["spec"]["containers"]
    environment = {entry["name"]: entry for entry in container["env"]}
    assert environment["REVISIT_ADVERTISE_ADDRESS"]["value"] == "$(POD_IP):50051"
    assert environment["REVISIT_STORE"]["valueFrom"]["secretKeyRef"] == {
        "name": "database", "key": "url"}
    migration = made["Job", "fleet-migrate"]
    assert "pre-upgrade" in migration["metadata"]["annotations"]["helm.sh/hook"]
    # Nobody sends calls to the pod that migrates.
    labels = migration["spec"]["template"]["metadata"]["labels"]
    assert labels["app.kubernetes.io/component"] == "migration"


@pytest.mark.parametrize("values", [OPEN, CLUSTER], ids=["alone", "cluster"])
def test_whoever_kills_a_server_waits_for_its_drain(values):
    for pod in pods(values):
        if pod["containers"][0]["name"] == "revisitd":
            assert pod["terminationGracePeriodSeconds"] > 15 + 10


@pytest.mark.parametrize(("values", "problem"), [
    ({"store.kind": "rocksdb"}, "allowed are sqlite and postgresql"),
    ({**OPEN, "store.kind": "postgresql"}, "name the secret"),
    ({}, "insecureAllowRemote"),
    ({**GUARDED, "tls.existingSecret": ""}, "tls.existingSecret"),
    ({"tls.existingSecret": "certificate", "policy.existingConfigMap": "policy"},
     "tls.clientCaSecret or policy.tokenIssuer"),
    ({**CLUSTER, **CONSOLE}, "console.server"),
    ({**GUARDED, **CONSOLE}, "console.tlsCaSecret"),
    ({**OPEN, **CONSOLE, "console.oidc.clientId": "a"}, "console.oidc"),
], ids=["kind", "secret", "unguarded", "no certificate", "no callers",
        "console of several", "console without authority", "console's issuer"])
def test_what_cannot_work_is_refused(values, problem):
    refused = helm("template", "fleet", CHART, "--kube-version", KUBERNETES[-1],
                   *flags(values))
    assert refused.returncode != 0
    assert problem in refused.stderr


def test_chart_is_of_the_version_of_the_tree():
    [version] = re.findall(r"^project\(revisit VERSION ([\d.]+)",
                           (ROOT / "CMakeLists.txt").read_text(), re.MULTILINE)
    chart = yaml.safe_load((CHART / "Chart.yaml").read_text())
    assert chart["appVersion"] == chart["version"] == version
