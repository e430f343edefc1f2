"""All figures that the simulation is given, each with where it comes from."""

import dataclasses
import pathlib
import re
import typing

_ROOT = pathlib.Path(__file__).resolve().parents[2]


class Figure(typing.NamedTuple):
    value: float
    unit: str
    source: str


def _of(path, pattern, unit, scale=1.0):
    """The number at the group of the pattern in a file of the product, which has to be
    there, once: so the simulation has what the product has, or does not start."""
    found = re.findall(pattern, (_ROOT / path).read_text())
    if len(found) != 1:
        raise ValueError(f"{path} has {pattern!r} {len(found)} times")
    return Figure(scale * float(found[0].replace("'", "")), unit, path)


def _member(path, name, unit="s"):
    """A default of an options struct in C++; milliseconds are given in seconds."""
    is_time = unit == "s"
    return _of(path, (rf"milliseconds {name}{{([\d']+)}};" if is_time
                      else rf"\b{name} = ([\d.]+);"), unit, 1e-3 if is_time else 1.0)


def _of_envoy(pattern, unit):
    return _of("deploy/cluster/envoy.yaml", pattern, unit)


# The name of a figure that nobody measured, so that it can be searched for.
ASSUMED = "assumed"
_SCALE = ("measured 2026-11-22 on 2 cores that others used too, load 8 to 15, "
          "libpq ingest of real 64-pose rows")
_BENCH = "tests/bench/RESULTS.md, tests/bench/run "
_PROTOCOL = "the protocol"
_OWNERSHIP = "server/storage/postgres/ownership.h"
_BACKOFF = "client/revisit/backoff.h"
_VEHICLE = "proto/revisit/v1/vehicle.proto"
_PING = r"# than every 10 s.\n +connection_keepalive: {"

FIGURES = {
    # The protocol.
    "ttl_s": _of("server/settings/settings.h", r"\blease_seconds = ([\d.]+);", "s"),
    "beat_s": _member(_OWNERSHIP, "beat_period"),
    "lease_margin_s": Figure(1.0, "s", _PROTOCOL),
    "lease_look_s": _member("server/admin/store_health.cc", "kPeriod"),
    "hold_s": _member(_OWNERSHIP, "least_stay"),
    "not_owner_retry_s": Figure(1.0, "s", _PROTOCOL + ": RetryInfo of NOT_OWNER, most"),
    "unavailable_retry_s": Figure(1.0, "s", "server/base/status.cc: RetryInfo of "
                                  "UNAVAILABLE where nothing else is said"),
    "rows_per_commit": Figure(64, "rows", _PROTOCOL),
    "writers": Figure(4, "connections", _PROTOCOL + ": 2 to 4 per server"),
    "connections": Figure(9, "connections", ASSUMED + " per server: 4 that write, "
                          "beat, claims, 3 that read"),
    "drain_notice_s": Figure(3.0, "s", _PROTOCOL),
    # The client library.
    "backoff_initial_s": _member(_BACKOFF, "initial"),
    "backoff_max_s": _member(_BACKOFF, "max"),
    "backoff_multiplier": _member(_BACKOFF, "multiplier", ""),
    "backoff_jitter": _member(_BACKOFF, "jitter", ""),
    "answer_timeout_s": _member("client/revisit/pose_stream.h", "answer_timeout"),
    # Envoy.
    "probe_interval_s": _of_envoy(r"\n      interval: (\d+)s\n", "s"),
    "probe_timeout_s": _of_envoy(r"\n    - timeout: (\d+)s\n", "s"),
    "unhealthy_after": _of_envoy(r" unhealthy_threshold: (\d+)\n", "probes"),
    "ping_interval_s": _of_envoy(_PING + r"interval: (\d+)s", "s"),
    "ping_timeout_s": _of_envoy(_PING + r"interval: \d+s, timeout: (\d+)s", "s"),
    "ping_jitter": Figure(0.15, "", "Envoy's default of interval_jitter"),
    "panic_percent": _of_envoy(r"healthy_panic_threshold: {value: (\d+)}", "%"),
    "table_size": _of_envoy(r"table_size: (\d+)}", "slots"),
    "hop_s": Figure(0.0005, "s", ASSUMED + ": one way within a data centre; Envoy adds "
                    "about as much (measured 2026-11-22: unary p50 1.1 -> 2.1 ms)"),
    # PostgreSQL.
    "flush_s": Figure(0.0031, "s", "measured 2026-11-22, fdatasync"),
    "row_cpu_s": Figure(13.8e-6, "s", _SCALE + ": 14.1 us with a fence at 1 pose a "
                        "row, less one pose"),
    "pose_cpu_s": Figure(0.34e-6, "s", _SCALE + ": 0.55 us a pose at 64 poses a row, "
                         "less the row's share"),
    "statement_cpu_s": Figure(100e-6, "s", ASSUMED),
    "wal_row_1": Figure(382, "B", _SCALE + ", inline, fence"),
    "wal_pose_64": Figure(103, "B", _SCALE + ", inline"),
    "disk_row_1": Figure(220, "B", _SCALE + ", inline"),
    "disk_pose_80": Figure(103, "B", _SCALE + ", inline, rows filled by bytes"),
    "database_cores": Figure(16, "cores", ASSUMED),
    "database_send_Bps": Figure(1.25e9, "B/s", ASSUMED + ": 10 Gbit/s"),
    "database_wal_Bps": Figure(200e6, "B/s", ASSUMED),
    "database_disk_B": Figure(10e12, "B", ASSUMED),
    "database_connections": Figure(500, "connections", ASSUMED + ": PostgreSQL serves "
                                   "more, each snapshot then costs more"),
    "promote_s": Figure(0.24, "s", "measured 2026-11-22, pg_promote alone"),
    # revisitd.
    "load_node_s": Figure(0.53e-6, "s", "measured 2026-11-23: CPU of a replay of "
                          "1,000,000 nodes"),
    "snapshot_node_s": Figure(0.12e-6, "s", "measured 2026-11-23: the same from a "
                              "snapshot"),
    "snapshot_node_B": Figure(94.7, "B", _BENCH + "--fleet: graph; a snapshot is "
                              + ASSUMED + " to be as large"),
    "node_B": Figure(112.2, "B", _BENCH + "--fleet: as loaded"),
    "first_search_checks": Figure(50, "checks", "docs/limits.md: a first search after "
                                  "a load is as much as some fifty searches"),
    "fewest_asked": _of("server/storage/postgres/ask_pacing.h",
                        r"\bkFewest = (\d+);", "vehicles"),
    "server_cores": Figure(8, "cores", ASSUMED),
    "envoy_cores": Figure(8, "cores", ASSUMED + ": of all Envoys of a cell together"),
    "server_memory_B": Figure(64e9, "B", ASSUMED),
    # The fleet.
    "vehicles": Figure(1_000_000, "", "the question"),
    "servers": Figure(100, "", "the question"),
    "pose_hz": Figure(1.0, "1/s", "the question"),
    "hours_a_day": Figure(2.0, "h", "the question"),
    "speed_mps": Figure(10.0, "m/s", "the question"),
    "peak_to_mean": Figure(3.0, "", "the question"),
    "node_m": _of(_VEHICLE, r"\[0\.01, 1000\], default (\d+)\.", "m"),
    "check_m": _of(_VEHICLE, r"one node spacing, default (\d+)\.", "m"),
}

# Seconds of one check by nodes of history (tests/bench/RESULTS.md, tests/bench/run
# --core): under dead reckoning, with a belief, where the claimed uncertainty and with
# it the area that is searched grows with the drive; and with fixes, where it does not.
CHECK_S = {
    "reckoned": ((1e3, 0.49e-3), (1e4, 1.3e-3), (1e5, 24e-3), (1e6, 104e-3)),
    "fixes": ((1e3, 0.241e-3), (1e4, 0.302e-3), (1e5, 0.631e-3), (1e6, 0.631e-3)),
    # Streams that ask for no candidates.
    "none": ((1e3, 1e-12), (1e6, 1e-12)),
}

# CPU seconds of a message by messages a second, for (part, poses a message): what is
# done once for whatever has come costs the less a message the more come.
# Measured 2026-11-24 by tests/simulation/measure.py, two cores with a load of 15.
MESSAGE_S = {
    ("revisitd", 1): ((118, 612e-6), (606, 194e-6), (1253, 138e-6)),
    ("Envoy", 1): ((118, 454e-6), (606, 147e-6), (1253, 114e-6)),
    ("revisitd", 64): ((120, 605e-6), (399, 399e-6)),
    ("Envoy", 64): ((120, 396e-6), (399, 269e-6)),
}

# Groups of real rows of 64 poses (columns: rows a commit, connections, thousand poses
# a second in the median, p50 of a commit in ms), one fenced statement each.
MEASURED_INGEST = ((1, 1, 22, 2.3), (8, 4, 242, 5.0), (64, 1, 254, 9.0),
                   (64, 4, 839, 18.0), (256, 4, 934, 67.0))

Parameters = dataclasses.make_dataclass(
    "Parameters",
    [(name, float, figure.value) for name, figure in FIGURES.items()])


@dataclasses.dataclass
class Policy:
    """Decisions of the protocol that the scenarios compare. The defaults are those that
    the results argue for."""

    # Writes are compared with owner, epoch and sequence. Off: to show that the
    # simulation finds what the fence prevents.
    fence: bool = True
    # A server that could not read the others' beats for a while forgets how long
    # it has seen each, and watches for a whole TTL again before it buries.
    watch_anew: bool = True
    # RetryInfo says how long a client waits; its own back-off counts only where
    # there is none. The library's rule of 2026-11 is the longer of the two.
    retry_info_rules: bool = True
    # Where the owner's beat is overdue, NOT_OWNER's RetryInfo ends after the moment
    # at which the owner can be buried, instead of after 0 to 1 s: fewer calls, but an
    # owner that only slept is found later.
    retry_after_burial: bool = False
    # A server that claims a vehicle anew, with the next epoch after its own and a
    # sequence that it wrote, keeps its graph instead of loading it.
    keep_graph: bool = True
    # Beats wait for the synchronous standby like every other write.
    replicated_beats: bool = True
    # Vehicles that may wait for a load on one server before callers are sent
    # away with a RetryInfo; None: no limit.
    load_queue: typing.Optional[int] = None
    # A server asks for no more vehicles at a time than came to it within two beats, or
    # `fewest_asked`; callers of the others are told who has them, as in any case.
    # Off: it asks for every one.
    paced_handovers: bool = True
    # A stream opens only while the lease runs: the sequence that it is answered with
    # is a read from memory like any other.
    lease_to_open: bool = True
    # A server whose lease has run out is not healthy, and sends away who is there, as
    # the real ones do. Off: it keeps its streams and gets new ones until it reaches the
    # database again.
    leave_without_lease: bool = True
    # Clients go to the owner that NOT_OWNER names.
    owner_header: bool = True
