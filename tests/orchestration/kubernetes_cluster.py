"""Kubernetes on this machine: etcd, the servers of Kubernetes, and one node with
containerd and runc. They use fixed ports, addresses and folders, so they live in name
spaces that `tests/orchestration/run --cluster` makes and that end them."""

import contextlib
import hashlib
import io
import json
import os
import pathlib
import re
import ssl
import subprocess
import sys
import tarfile
import time
import urllib.error
import urllib.request

import yaml

ROOT = pathlib.Path(__file__).resolve().parents[2]
TOOLS = pathlib.Path(os.environ["REVISIT_TOOLS"])
BIN = pathlib.Path(os.environ["REVISIT_BIN"])
PROGRAMS = TOOLS / "kubernetes/bin"
# The node's address, and those of its pods and of the services.
NODE = "10.71.1.1"
PODS = "10.71.2.0/24"
SERVICES = "10.71.3.0/24"
API = f"https://{NODE}:6443"
TOKEN = "administrator"
START_SECONDS = 60
PAUSE = "localhost/pause:1"

sys.path.insert(0, str(ROOT / "deploy/cluster"))
from private_cluster import Postgres  # noqa: E402

# Those of the caller may name a proxy, or settings of revisitd.
ENVIRONMENT = {"PATH": f"{PROGRAMS}:/usr/local/sbin:/usr/local/bin:/usr/sbin:"
                       "/usr/bin:/sbin:/bin", "LC_ALL": "C",
               # This resolver is content with /etc/hosts, and no DNS is reached here.
               "GRPC_DNS_RESOLVER": "native"}


class RefusedError(Exception):
    """An error that the API server answered."""

    def __init__(self, code, message):
        super().__init__(f"{code}: {message}")
        self.code = code


def wait_until(condition, what, seconds=START_SECONDS):
    """Returns what `condition` gives when that is true."""
    deadline = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < deadline, f"no {what} within {seconds} s"
        time.sleep(0.2)
    return value


def run(*command, **more):
    made = subprocess.run([*map(str, command)], capture_output=True, text=True,
                          check=False, env=ENVIRONMENT, **more)
    assert made.returncode == 0, f"{command}\n{made.stderr}{made.stdout}"
    return made.stdout


def _libraries(program):
    """The shared libraries that a program is loaded with."""
    return re.findall(r"(/\S+) \(0x", run("ldd", program))


def _write_image(path, names, files, config):
    """Writes an image of one layer as `docker save` does. `files` maps paths in the
    image to paths here."""
    layer = io.BytesIO()
    with tarfile.open(fileobj=layer, mode="w") as tar:
        for name, file in files.items():
            made = tar.gettarinfo(os.path.realpath(file), name.lstrip("/"))
            made.uid = made.gid = 0
            with open(file, "rb") as content:
                tar.addfile(made, content)
    data = layer.getvalue()
    config = {"architecture": "amd64", "os": "linux", "config": config,
              "rootfs": {"type": "layers", "diff_ids": [
                  f"sha256:{hashlib.sha256(data).hexdigest()}"]}}
    manifest = [{"Config": "config.json", "RepoTags": names,
                 "Layers": ["layer.tar"]}]
    with tarfile.open(path, "w") as tar:
        for name, content in (("config.json", json.dumps(config).encode()),
                              ("layer.tar", data),
                              ("manifest.json", json.dumps(manifest).encode())):
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))


class Cluster:
    """Kubernetes and its node, ready. Their logs lie in the directory of `processes`,
    which stops them; all other files lie in `scratch`."""

    def __init__(self, processes, scratch, cgroup):
        self._processes = processes
        self._scratch = scratch
        self._cgroup = cgroup
        self._started = []
        self._postgres = None
        self._start_control_plane()
        self._start_node()

    def _start(self, name, *command):
        process = self._processes.start(name, *command, env=ENVIRONMENT,
                                        cwd=self._scratch)
        self._started.append(process)
        return process

    def _start_control_plane(self):
        scratch = self._scratch
        key = scratch / "accounts.key"
        run("openssl", "genrsa", "-out", key, "2048")
        tokens = scratch / "tokens.csv"
        tokens.write_text(f'{TOKEN},administrator,1,"system:masters"\n')
        self._start("etcd", PROGRAMS / "etcd", "--data-dir", scratch / "etcd",
                    "--listen-peer-urls", "http://127.0.0.1:2380")
        self._start(
            "kube-apiserver", PROGRAMS / "kubernetes", "kube-apiserver",
            "--etcd-servers=http://127.0.0.1:2379", f"--advertise-address={NODE}",
            f"--service-cluster-ip-range={SERVICES}",
            f"--cert-dir={scratch}/certificates", f"--token-auth-file={tokens}",
            "--authorization-mode=RBAC", f"--service-account-key-file={key}",
            f"--service-account-signing-key-file={key}",
            "--service-account-issuer=https://kubernetes.default.svc")
        self.authority = scratch / "certificates/apiserver.crt"
        self.config = scratch / "kubeconfig"
        self.config.write_text(yaml.safe_dump({
            "apiVersion": "v1", "kind": "Config", "current-context": "here",
            "clusters": [{"name": "here", "cluster": {
                "server": API, "certificate-authority": str(self.authority)}}],
            "users": [{"name": "administrator", "user": {"token": TOKEN}}],
            "contexts": [{"name": "here", "context": {
                "cluster": "here", "user": "administrator"}}]}))
        # Helm warns of one that others may read.
        self.config.chmod(0o600)
        wait_until(self._is_ready, "API server")
        common = [f"--kubeconfig={self.config}"]
        self._start("kube-controller-manager", PROGRAMS / "kubernetes",
                    "kube-controller-manager", *common, "--leader-elect=false",
                    f"--cert-dir={scratch}/certificates-of-manager",
                    f"--service-account-private-key-file={key}",
                    f"--root-ca-file={self.authority}")
        self._start("kube-scheduler", PROGRAMS / "kubernetes", "kube-scheduler",
                    *common, "--leader-elect=false",
                    f"--cert-dir={scratch}/certificates-of-scheduler")

    def _check(self):
        for process in self._started:
            process.check()

    def _is_ready(self):
        self._check()
        if not self.authority.exists():
            return False
        try:
            self.ask("GET", "/readyz", parse=False)
        except (OSError, RefusedError):
            return False
        return True

    def ask(self, method, path, body=None, kind="application/json", parse=True):
        """Asks the API server and returns its answer. Raises RefusedError if that is an
        error, OSError if there is none."""
        request = urllib.request.Request(
            f"{API}{path}", method=method,
            data=None if body is None else json.dumps(body).encode(),
            headers={"Authorization": f"Bearer {TOKEN}", "Content-Type": kind})
        opener = urllib.request.build_opener(
            urllib.request.ProxyHandler({}), urllib.request.HTTPSHandler(
                context=ssl.create_default_context(cafile=self.authority)))
        try:
            with opener.open(request, timeout=START_SECONDS) as answer:
                text = answer.read().decode()
        except urllib.error.HTTPError as error:
            text = error.read().decode()
            with contextlib.suppress(ValueError, KeyError):
                text = json.loads(text)["message"]
            raise RefusedError(error.code, text) from None
        return json.loads(text) if parse else text

    def helm(self, *arguments):
        """Runs Helm; returns its CompletedProcess."""
        return subprocess.run(
            [TOOLS / "helm", *map(str, arguments), "--kubeconfig", self.config],
            capture_output=True, text=True, check=False, cwd=ROOT,
            env={**ENVIRONMENT, "HOME": str(self._scratch)})

    def add_host(self, host, address):
        """Gives an address a name on the node."""
        with open("/etc/hosts", "a") as file:
            file.write(f"{address} {host}\n")

    def _start_node(self):
        scratch = self._scratch
        network = scratch / "network"
        network.mkdir()
        (network / "pods.conflist").write_text(json.dumps({
            "cniVersion": "0.4.0", "name": "pods", "plugins": [{
                "type": "ptp", "ipam": {
                    "type": "host-local", "dataDir": str(scratch / "addresses"),
                    "ranges": [[{"subnet": PODS}]],
                    "routes": [{"dst": "0.0.0.0/0"}]}}]}))
        socket = scratch / "containerd.sock"
        config = scratch / "containerd.toml"
        config.write_text(f"""
version = 2
root = "{scratch}/containerd"
state = "{scratch}/containerd-state"
[grpc]
  address = "{socket}"
[plugins."io.containerd.grpc.v1.cri"]
  sandbox_image = "{PAUSE}"
  # Root may not always have the right to lower the score of a process.
  restrict_oom_score_adj = true
  [plugins."io.containerd.grpc.v1.cri".cni]
    bin_dir = "{TOOLS}/kubernetes/cni"
    conf_dir = "{network}"
""")
        self._start("containerd", PROGRAMS / "containerd", "--config", config)
        self._containers = [PROGRAMS / "ctr", "--address", socket,
                            "--namespace", "k8s.io"]
        wait_until(lambda: self._check() or subprocess.run(
            [*map(str, self._containers), "version"], capture_output=True,
            check=False).returncode == 0, "containerd")
        self._import_images()
        kubelet = scratch / "kubelet.yaml"
        kubelet.write_text(yaml.safe_dump({
            "apiVersion": "kubelet.config.k8s.io/v1beta1",
            "kind": "KubeletConfiguration",
            "authentication": {"anonymous": {"enabled": True},
                               "webhook": {"enabled": False}},
            "authorization": {"mode": "AlwaysAllow"},
            "cgroupDriver": "cgroupfs", "cgroupRoot": self._cgroup,
            "failSwapOn": False, "resolvConf": "",
            "volumePluginDir": str(scratch / "plugins"),
            # The disk is the whole machine's, however full that is.
            "imageGCHighThresholdPercent": 100,
            "evictionHard": {"nodefs.available": "0%", "imagefs.available": "0%",
                             "memory.available": "0%"}}))
        self._start("kubelet", PROGRAMS / "kubernetes", "kubelet",
                    f"--kubeconfig={self.config}", f"--config={kubelet}",
                    f"--root-dir={scratch}/kubelet", "--hostname-override=node",
                    f"--node-ip={NODE}",
                    f"--container-runtime-endpoint=unix://{socket}")
        self._start("kube-proxy", PROGRAMS / "kubernetes", "kube-proxy",
                    f"--kubeconfig={self.config}", "--hostname-override=node",
                    f"--cluster-cidr={PODS}", "--conntrack-max-per-core=0",
                    "--conntrack-tcp-timeout-established=0s",
                    "--conntrack-tcp-timeout-close-wait=0s")
        wait_until(self._has_node, "node")

    def _has_node(self):
        self._check()
        try:
            node = self.ask("GET", "/api/v1/nodes/node")
        except RefusedError:
            return False
        return "taints" not in node["spec"] and any(
            entry["type"] == "Ready" and entry["status"] == "True"
            for entry in node["status"]["conditions"])

    def _import_images(self):
        """Gives containerd an image of the programs that are tested and their
        libraries, with the user, the entry point and the variables of
        deploy/image/Containerfile."""
        text = (ROOT / "deploy/image/Containerfile").read_text()
        [user] = re.findall(r"^USER (\S+)$", text, re.MULTILINE)
        [entry] = re.findall(r"^ENTRYPOINT (.*)$", text, re.MULTILINE)
        files = {f"/usr/bin/{name}": BIN / name for name in ("revisitd", "revisit")}
        for program in list(files.values()):
            files.update({path: path for path in _libraries(program)})
        version = yaml.safe_load(
            (ROOT / "deploy/chart/Chart.yaml").read_text())["appVersion"]
        pause = str(PROGRAMS / "pause")
        for names, content, config in (
                ([PAUSE], {"/pause": pause},
                 {"User": "65535:65535", "Entrypoint": ["/pause"]}),
                ([f"localhost/revisit:{version}", "localhost/revisit:next",
                  # As docs/operate.md calls it.
                  f"registry.example/revisit:{version}"], files,
                 {"User": user, "Entrypoint": json.loads(entry),
                  "Env": re.findall(r"(REVISIT_\w+=\S+)",
                                    text[text.index("\nENV REVISIT_"):])})):
            path = self._scratch / "image.tar"
            _write_image(path, names, content, config)
            run(*self._containers, "images", "import", path)
            path.unlink()

    def postgres(self):
        """A PostgreSQL outside of the cluster, as the chart wants it; starts it the
        first time."""
        if self._postgres is None:
            self._postgres = Postgres(self._processes, NODE, PODS)
        return self._postgres
