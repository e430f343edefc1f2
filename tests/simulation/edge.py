"""Envoy: the maglev table, health checks, and the owner that a client names."""

import array
import functools


def _mix(x):
    """A good 64-bit hash of a small integer (the finaliser of splitmix64)."""
    x = (x + 0x9E3779B97F4A7C15) & (2 ** 64 - 1)
    x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & (2 ** 64 - 1)
    x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & (2 ** 64 - 1)
    return x ^ (x >> 31)


def hash_of(vehicle):
    return _mix(vehicle)


@functools.lru_cache(maxsize=64)
def maglev(hosts, size):
    """The table of Eisenbud et al., "Maglev", 2016, section 3.4: host by slot.
    REQUIRES: hosts is a sorted tuple of numbers, size a prime."""
    if not hosts:
        return array.array("h")
    steps = [(_mix(2 * host) % size, _mix(2 * host + 1) % (size - 1) + 1)
             for host in hosts]
    nexts = [0] * len(hosts)
    table = array.array("h", [-1]) * size
    filled = 0
    while True:
        for i, (offset, skip) in enumerate(steps):
            slot = (offset + nexts[i] * skip) % size
            while table[slot] >= 0:
                nexts[i] += 1
                slot = (offset + nexts[i] * skip) % size
            nexts[i] += 1
            table[slot] = hosts[i]
            filled += 1
            if filled == size:
                return table


class Envoy:
    """One proxy with its own opinion of who is healthy."""

    def __init__(self, kernel, parameters, servers):
        self._kernel = kernel
        self._p = parameters
        self._servers = servers
        self._by_address = {server.address: i for i, server in enumerate(servers)}
        self._failures = [0] * len(servers)
        self._healthy = tuple(range(len(servers)))
        # Servers that this proxy cannot reach, by number.
        self.cut = set()
        for i in range(len(servers)):
            kernel.after(parameters.probe_interval_s * kernel.random.random(),
                         self._probe, i)

    def _probe(self, i):
        reached = i not in self.cut and not self._servers[i].frozen
        fine = reached and self._servers[i].serving
        # A refusal is known at once, silence after the timeout.
        late = 0.0 if reached else self._p.probe_timeout_s
        self._kernel.after(late, self._probed, i, fine)
        self._kernel.after(max(self._p.probe_interval_s, late), self._probe, i)

    def _probed(self, i, fine):
        self._failures[i] = 0 if fine else self._failures[i] + 1
        healthy = self._failures[i] < self._p.unhealthy_after
        if healthy != (i in self._healthy):
            self._healthy = tuple(sorted(
                {*self._healthy, i} if healthy else set(self._healthy) - {i}))

    def route(self, vehicle, owner=None):
        """The server for a new call, or None. An owner that is not healthy here
        falls back to the hash. Where too few are healthy, all count ("panic")."""
        named = self._by_address.get(owner)
        if named in self._healthy:
            return self._reach(named)
        hosts = self._healthy
        if 100.0 * len(hosts) < self._p.panic_percent * len(self._servers):
            hosts = tuple(range(len(self._servers)))
        if not hosts:
            return None
        size = int(self._p.table_size)
        return self._reach(maglev(hosts, size)[hash_of(vehicle) % size])

    def _reach(self, i):
        return None if i in self.cut else self._servers[i]
