"""What the scenarios are said to show, on several seeds, each on a small part."""

import dataclasses
import pathlib
import subprocess
import sys

import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import death
import failover
import ingest
import opinions
import parameters
import restarts
import sizing
import standby
import tables

P = parameters.Parameters()
Policy = parameters.Policy
SEEDS = (1, 2)
# 100 streams a server on a 25th of its PostgreSQL, whose network then is what loads
# wait for: the one thread that a server has at least is more than its part.
SMALL = 0.04


# -- Sizes


def test_the_paper_s_figures_follow_from_the_fleet():
    """Expected: the sizing table of the design, by hand from 1 Hz, 2 h a day, 10 m/s,
    peak 3 x mean, a million vehicles on 100 servers."""
    paper = {name: value for name, (value, _) in sizing.paper(P).items()}
    assert paper["poses a second, mean"] == pytest.approx(83e3, rel=0.01)
    assert paper["poses a second, peak"] == pytest.approx(250e3, rel=0.01)
    assert paper["poses a day"] == pytest.approx(7.2, rel=0.01)
    assert paper["disk a day, rows filled"] == pytest.approx(740, rel=0.01)
    assert paper["WAL a day, 1 pose a row"] == pytest.approx(2.7, rel=0.05)
    assert paper["rows of 64 a second, peak"] == pytest.approx(4000, rel=0.05)
    assert paper["connections"] == 900
    assert paper["nodes a vehicle and day"] == 36e3
    # 3.7 MB and 37 GB at 103 bytes a node; as loaded a node takes 112.
    assert paper["memory a vehicle and day"] == pytest.approx(3.7, rel=0.1)
    assert paper["memory a server and day, all vehicles"] == pytest.approx(37, rel=0.1)
    assert paper["a dead server's rows, 30 days, all vehicles"] == pytest.approx(
        220, rel=0.02)


def test_checks_take_what_was_measured_and_lie_between_elsewhere():
    assert sizing.check_seconds(1e4) == pytest.approx(1.3e-3)
    assert sizing.check_seconds(1e6) == pytest.approx(0.104)
    assert 1.3e-3 < sizing.check_seconds(3e4) < 24e-3
    assert sizing.check_seconds(2e6) > 0.104
    assert sizing.check_seconds(1e5, "fixes") == pytest.approx(0.631e-3)


def test_messages_take_what_was_measured_and_less_the_more_come():
    for (part, poses), points in parameters.MESSAGE_S.items():
        for rate, seconds in points:
            assert sizing.message_seconds(part, poses, rate) == pytest.approx(seconds)
        rates = [1.0, 300.0, 1000.0, 5000.0]
        costs = [sizing.message_seconds(part, poses, rate) for rate in rates]
        assert costs == sorted(costs, reverse=True)


def test_history_breaks_a_cell_before_its_rows_do():
    cells = sizing.Fleet(1e6, 100, 10, 1)
    used = sizing.shares(P, cells._replace(days=30))
    for resource in ("CPU of PostgreSQL", "WAL of PostgreSQL", "disk of PostgreSQL",
                     "connections of PostgreSQL", "CPU of a server, acks"):
        assert used[resource] < 0.3
    for resource in ("CPU of a server, checks", "memory of a server"):
        assert used[resource] > 5
    for checks, first in (("reckoned", "CPU of a server, checks"),
                          ("fixes", "memory of a server"),
                          ("none", "memory of a server")):
        name, share = sizing.first_to_break(
            P, cells._replace(days=30, checks=checks))
        assert name == first and share > 5


def test_one_primary_ends_by_its_connections_first():
    assert sizing.first_to_break(P, sizing.Fleet(1e6, 100, 1, 1))[0] == (
        "connections of PostgreSQL")


def test_what_a_server_can_hold_is_where_its_first_resource_is_full():
    fleet = sizing.Fleet(1e6, 100, 10, 7)
    most, why = sizing.vehicles_per_server(P, fleet)
    for factor, broken in ((0.99, False), (1.01, True)):
        name, share = sizing.first_to_break(
            P, fleet._replace(vehicles=most * fleet.servers * factor))
        assert name == why and (share > 1) == broken


@pytest.mark.parametrize("seed", SEEDS)
def test_the_reload_of_a_dead_server_takes_what_the_arithmetic_says(seed):
    result = death.die(death.setup_of(seed, 10, 7, SMALL))
    share = sizing.shares(P, sizing.Fleet(1e6, 100, 10, 7))
    reload_s = share["reload after a death, of 60 s"] * P.answer_timeout_s
    # The table divides unevenly, and reading and building do not always overlap.
    took = result["last loaded"] - result["buried after"]
    assert reload_s <= took <= 2.0 * reload_s + 2.0


def test_a_cell_keeps_up_with_its_peak_and_one_primary_needs_more_than_4_cores():
    peak = P.vehicles * P.hours_a_day / 24 * P.peak_to_mean
    cell = ingest.ingest(1, P, 10, peak / 10, 1, seconds=0.5)
    assert cell["kept up %"] > 95 and cell["CPU of PostgreSQL %"] < 20
    assert cell["ack p99 ms"] < 30
    four = dataclasses.replace(P, database_cores=4)
    one = ingest.ingest(1, four, 100, peak, 1, seconds=0.5)
    assert one["CPU of PostgreSQL %"] > 95


# -- Death of a server


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("number", (10, 100))
def test_vehicles_of_a_dead_server_come_back_after_the_ttl(seed, number):
    result = death.die(death.setup_of(seed, number, 1, SMALL), after=40.0)
    assert result["waiting"] == 0 and result["timeouts"] == 0
    assert P.ttl_s - P.beat_s <= result["buried after"] <= P.ttl_s + 2 * P.beat_s
    assert result["buried after"] <= result["gap p50"] + 2.0
    assert result["gap most"] <= P.ttl_s + 2 * P.beat_s + 6.0
    assert result["loads"] == round(2500 * SMALL)


@pytest.mark.parametrize("seed", SEEDS)
def test_long_histories_make_the_storm_outlast_the_clients_patience(seed):
    month = death.die(death.setup_of(seed, 10, 30, SMALL))
    kept = death.die(death.setup_of(seed, 10, 30, SMALL, kept=0.091))
    assert month["gap p99"] > 50
    assert kept["gap most"] < 25
    assert kept["timeouts"] == 0


def test_snapshots_as_large_as_graphs_take_longer_to_read_than_rows_to_build():
    rows = death.die(death.setup_of(1, 10, 7, SMALL))
    snapshots = death.die(death.setup_of(1, 10, 7, SMALL, snapshots=True))
    assert snapshots["gap p99"] > 1.5 * rows["gap p99"]
    fast = death.die(death.setup_of(1, 10, 7, SMALL, snapshots=True,
                                    database_send_Bps=12.5e9))
    assert fast["gap p99"] < rows["gap p99"]


def test_snapshots_shorten_the_storm_where_poses_come_more_densely_than_nodes():
    storms = {
        (hertz, snapshots): death.die(death.setup_of(
            1, 10, 7, SMALL, pose_hz=hertz, snapshots=snapshots))["gap p99"]
        for hertz in (5.0, 10.0) for snapshots in (False, True)}
    # A pose for each node, then two.
    assert storms[5.0, True] == pytest.approx(storms[5.0, False], rel=0.15)
    assert storms[10.0, True] < 0.7 * storms[10.0, False]


@pytest.mark.parametrize("seed", SEEDS)
def test_a_limit_of_loads_that_wait_brings_nobody_back_sooner(seed):
    free = death.die(death.setup_of(seed, 10, 30, SMALL))
    limited = death.die(death.setup_of(seed, 10, 30, SMALL, Policy(load_queue=8)))
    assert limited["gap p99"] == pytest.approx(free["gap p99"], rel=0.1)
    assert limited["timeouts"] == 0


@pytest.mark.parametrize("seed", SEEDS)
def test_a_back_off_of_one_s_own_delays_what_retry_info_would_not(seed):
    rules = death.die(death.setup_of(seed, 10, 1, SMALL), after=60.0)
    longer = death.die(death.setup_of(
        seed, 10, 1, SMALL, Policy(retry_info_rules=False)), after=60.0)
    assert longer["gap p99"] > rules["gap p99"] + 1.0
    assert longer["refusals a vehicle"] < rules["refusals a vehicle"]


def test_a_server_that_slept_for_about_the_ttl_need_not_load_what_it_gave_up():
    kept, anew = (
        [death.freeze(death.setup_of(seed, 10, 7, SMALL, Policy(
                keep_graph=keep, paced_handovers=False)), 9.0)
         for seed in SEEDS] for keep in (True, False))
    assert all(result["waiting"] == 0 for result in kept)
    assert sum(result["gap most"] for result in kept) < 0.8 * sum(
        result["gap most"] for result in anew)


# -- Restarts


@pytest.mark.parametrize("seed", SEEDS)
def test_a_rolling_restart_that_waits_for_loads_lets_nobody_wait_long(seed):
    hasty = restarts.roll(restarts.setup_of(seed, SMALL), 0.0)
    patient = restarts.roll(restarts.setup_of(seed, SMALL), None)
    assert patient["waiting"] == 0
    assert 1.5 * patient["gap p99"] < hasty["gap p99"]
    assert 1.0 <= patient["moves a vehicle"] < 2.0
    # Every stream that a restarted server had is elsewhere, and stays there.
    assert patient["emptiest at the end"] == 0


# -- Failover


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("outage", (1.0, 15.0))
def test_a_synchronous_failover_loses_buries_and_loads_nothing(seed, outage):
    result = failover.fail_over(failover.setup_of(seed, SMALL), outage)
    for nothing in ("poses lost", "untold", "servers buried", "loads", "waiting"):
        assert result[nothing] == 0
    # RetryInfo of up to a second, then the claims.
    assert result["gap most"] < outage + 3.0


@pytest.mark.parametrize("seed", SEEDS)
def test_an_outage_beyond_the_ttl_buries_the_living_if_old_sightings_count(seed):
    kept, anew = (
        failover.fail_over(failover.setup_of(
            seed, SMALL, Policy(watch_anew=False, keep_graph=keep)), 15.0)
        for keep in (True, False))
    assert kept["servers buried"] >= 2
    # What comes back to them finds the graphs that they kept.
    assert kept["loads"] < 0.8 * anew["loads"]


@pytest.mark.parametrize("seed", SEEDS)
def test_an_asynchronous_failover_loses_its_lag_and_tells_everybody(seed):
    lag = 2.0
    result = failover.fail_over(failover.setup_of(seed, SMALL, lag=lag), 5.0,
                                after=90.0)
    # 25,000 vehicles whose messages of 5 poses come every 5 s.
    assert result["vehicles"] == pytest.approx(25_000 * lag / 5.0, rel=0.15)
    assert result["poses lost"] == pytest.approx(25_000 * lag, rel=0.15)
    assert result["told"] == result["vehicles"] and result["untold"] == 0
    assert result["waiting"] == 0


# -- Opinions


@pytest.mark.parametrize("seed", SEEDS)
def test_two_opinions_move_nobody_whose_callers_agree(seed):
    result = opinions.disagree(opinions.setup_of(seed, SMALL), 60.0, 0.3)
    assert result["moves of others"] == 0
    assert result["moves a shared vehicle"] > 0


@pytest.mark.parametrize("seed", SEEDS)
def test_the_owner_header_ends_the_dispute_and_the_hold_bounds_it(seed):
    named = opinions.disagree(opinions.setup_of(seed, SMALL), 120.0, 1.0)
    unnamed = opinions.disagree(opinions.setup_of(
        seed, SMALL, Policy(owner_header=False)), 120.0, 1.0)
    assert named["moves a shared vehicle"] <= 3
    assert unnamed["moves a shared vehicle"] > 2 * named["moves a shared vehicle"]
    assert unnamed["calls failed %"] > 5 * named["calls failed %"]
    for result in (named, unnamed):
        assert result["shortest stay"] >= P.hold_s
    assert named["waiting"] == 0


@pytest.mark.parametrize("seed", SEEDS)
def test_paced_handovers_spare_streams_the_queue_of_loads(seed):
    """Once both Envoys agree again, all vehicles of the server are asked back."""
    at_once, paced = (
        opinions.disagree(opinions.setup_of(
            seed, SMALL, Policy(paced_handovers=pace)), 60.0, 1.0)
        for pace in (False, True))
    assert at_once["gap p99"] > 12
    assert paced["gap p99"] < 8
    assert paced["waiting"] == 0
    assert paced["calls failed %"] < 10


# -- The standby


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("seconds", (0.5, 7.0))
def test_a_standby_that_stalls_within_the_lease_costs_its_stall_and_no_load(
        seed, seconds):
    result = standby.stall(standby.setup_of(seed, SMALL), seconds)
    assert result["gap most"] == pytest.approx(seconds, abs=0.2)
    assert result["loads"] == result["servers buried"] == result["streams anew"] == 0
    assert result["waiting"] == 0 and result["caught up after"] < 4.0


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("seconds", (15.0, 45.0))
def test_a_standby_that_stalls_beyond_the_lease_ends_streams_and_costs_little_more(
        seed, seconds):
    result = standby.stall(standby.setup_of(seed, SMALL), seconds)
    assert result["streams anew"] >= 25_000
    assert seconds < result["gap most"] < seconds + 4.0
    assert result["servers buried"] == 0 and result["loads"] < 0.05 * 25_000
    assert result["waiting"] == 0 and result["caught up after"] < 5.0


@pytest.mark.parametrize("seed", SEEDS)
def test_beats_that_do_not_wait_for_the_standby_keep_reads_going(seed):
    waits = standby.stall(standby.setup_of(seed, SMALL), 15.0)
    local = standby.stall(standby.setup_of(
        seed, SMALL, Policy(replicated_beats=False)), 15.0)
    assert waits["no reads, server s"] > 20
    assert local["no reads, server s"] == 0


# -- What is printed


def test_a_table_prints_medians_and_the_ranges_that_say_something():
    table = tables.Table("T", ("name", "x"))
    table.add(name="a", x=[1.0, 3.0, 2.0])
    table.add(name="b", x=[100.0, 101.0, 100.5])
    assert table.text() == (
        "T\n\nname        x\na     2 (1-3)\nb       100.5\n")


def test_every_figure_says_where_it_comes_from():
    for name, figure in parameters.FIGURES.items():
        assert figure.source, name
        assert any(word in figure.source for word in (
            "measured", parameters.ASSUMED, "RESULTS.md", "the protocol", "client/",
            "proto/", "server/", "docs/", "deploy/", "Envoy", "question")), name


def test_the_command_prints_what_it_is_asked_for_and_refuses_the_rest():
    run = pathlib.Path(__file__).parent / "simulation.py"
    sizes = subprocess.run([sys.executable, "-B", run, "sizing"], check=True,
                           capture_output=True, text=True)
    assert "breaks first" in sizes.stdout
    refused = subprocess.run([sys.executable, "-B", run, "size"], check=False,
                             capture_output=True, text=True)
    assert refused.returncode == 2 and "no scenario size" in refused.stderr
