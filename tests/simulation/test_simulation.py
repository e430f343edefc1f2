"""The simulator against closed forms, and against what its parts promise."""

import dataclasses
import math
import pathlib
import random
import statistics
import sys

import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import client
import cluster
import database
import edge
import ingest
import kernel as kernels
import parameters
import server as servers

SEEDS = (1, 2, 3)
P = parameters.Parameters()
TABLE_SIZE = int(P.table_size)


def mean_wait(seed, places, arrivals, service, count=60_000):
    """Mean time in the queue of a Line, Poisson arrivals."""
    kernel = kernels.Kernel(seed)
    line = kernels.Line(kernel, places)
    waits = []

    def arrive():
        came, seconds = kernel.now, service(kernel.random)
        line.request(seconds, lambda: waits.append(kernel.now - came - seconds))
        kernel.after(kernel.random.expovariate(arrivals), arrive)

    arrive()
    kernel.run(count / arrivals)
    return statistics.fmean(waits)


def erlang_c(places, load):
    """Probability of waiting in M/M/c, load = arrivals x service."""
    term = load ** places / math.factorial(places) * places / (places - load)
    return term / (sum(load ** k / math.factorial(k) for k in range(places)) + term)


@pytest.mark.parametrize("load", (0.3, 0.7, 0.8))
def test_one_place_makes_requests_wait_as_m_m_1_does(load):
    waits = [mean_wait(seed, 1, load, lambda r: r.expovariate(1.0)) for seed in SEEDS]
    assert statistics.fmean(waits) == pytest.approx(load / (1 - load), rel=0.08)


def test_one_place_with_equal_services_waits_half_as_long():
    waits = [mean_wait(seed, 1, 0.7, lambda _: 1.0) for seed in SEEDS]
    assert statistics.fmean(waits) == pytest.approx(0.7 / (2 * 0.3), rel=0.06)


def test_several_places_make_requests_wait_as_erlang_c_says():
    waits = [mean_wait(seed, 4, 3.2, lambda r: r.expovariate(1.0)) for seed in SEEDS]
    assert statistics.fmean(waits) == pytest.approx(
        erlang_c(4, 3.2) / (4 - 3.2), rel=0.1)


def test_a_line_that_is_never_empty_serves_one_after_the_other():
    kernel = kernels.Kernel(1)
    line = kernels.Line(kernel, 2)
    done = []
    for name in "abcde":
        line.request(1.0, lambda n=name: done.append((kernel.now, n)))
    kernel.run(10.0)
    assert done == [(1.0, "a"), (1.0, "b"), (2.0, "c"), (2.0, "d"), (3.0, "e")]
    assert line.busy_seconds == 5.0


def flush_latencies(seed, arrivals, count=20_000):
    kernel = kernels.Kernel(seed)
    log = kernels.Flushes(kernel, 1.0)
    latencies = []

    def arrive():
        came = kernel.now
        log.request(lambda: latencies.append(kernel.now - came))
        kernel.after(kernel.random.expovariate(arrivals), arrive)

    arrive()
    kernel.run(count / arrivals)
    return latencies


def test_a_log_that_is_always_being_flushed_takes_one_and_a_half_flushes():
    # A request comes at an even time of a flush, waits for its end, then for its own.
    assert statistics.fmean(flush_latencies(1, 50.0)) == pytest.approx(1.5, rel=0.01)


def test_a_log_that_is_seldom_flushed_takes_one_flush():
    # One in 1 + 1/a requests meets a flush under way and waits half of it, to the
    # first order in the arrivals a.
    assert statistics.fmean(flush_latencies(1, 0.02)) == pytest.approx(1.01, rel=0.01)


def test_equal_seeds_give_equal_runs_and_others_do_not():
    def gaps(seed):
        cell = cluster.Cluster(small(seed))
        cell.kill(cell.servers[1])
        cell.run(30.0)
        return cell.gaps()

    assert gaps(1) == gaps(1)
    assert gaps(1) != gaps(2)


# -- The edge and the client


def test_maglev_gives_every_host_about_the_same_share():
    table = edge.maglev(tuple(range(10)), TABLE_SIZE)
    counts = [table.count(host) for host in range(10)]
    assert max(counts) <= min(counts) + 1


def test_maglev_moves_little_beside_what_has_to_move():
    # 2 -> 3 hosts with 400 vehicles moved 132 in the trial with Envoy 1.40, none of
    # them between old hosts; the paper promises few, not none.
    size = TABLE_SIZE
    two, three = edge.maglev((0, 1), size), edge.maglev((0, 1, 2), size)
    slots = [edge.hash_of(vehicle) % size for vehicle in range(10_000)]
    to_new = sum(three[slot] == 2 for slot in slots)
    between_old = sum(three[slot] not in (2, two[slot]) for slot in slots)
    assert to_new == pytest.approx(10_000 / 3, rel=0.05)
    assert between_old < 0.15 * 10_000

    hundred = edge.maglev(tuple(range(100)), size)
    without = edge.maglev(tuple(i for i in range(100) if i != 7), size)
    moved = sum(a != b for a, b in zip(hundred, without)) / size
    assert 0.01 <= moved < 0.03


def test_a_dead_server_gets_no_calls_after_two_probes_and_a_live_one_does_again():
    cell = cluster.Cluster(small(1))
    cell.kill(cell.servers[0])
    cell.run(P.unhealthy_after * P.probe_interval_s + 0.01)
    assert all(cell.home(key) is not cell.servers[0] for key in cell.vehicles)
    cell.servers[0].start()
    cell.run(P.probe_interval_s + 0.01)
    assert any(cell.home(key) is cell.servers[0] for key in cell.vehicles)


def test_back_off_doubles_up_to_its_bound_and_waits_as_long_as_it_is_asked():
    backoff = client.Backoff(P, random.Random(1))
    for longest in (0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 10.0, 10.0):
        assert longest / 2 <= backoff.next(None, False) <= longest
    assert backoff.next(20.0, False) >= 20.0
    assert backoff.next(0.5, False) >= 5.0
    assert backoff.next(0.5, True) == 0.5
    backoff.reset()
    assert backoff.next(None, False) <= 0.1


# -- The protocol


def small(seed, streams=40, **changes):
    """A cell of four servers whose loads take no time to speak of."""
    return cluster.Setup(**{
        "seed": seed, "servers": 4, "streams_per_server": streams, "message_s": 1.0,
        "history_days": 0.01, **changes})


@pytest.mark.parametrize("seed", SEEDS)
def test_nothing_happens_to_a_cell_that_nobody_harms(seed):
    cell = cluster.Cluster(small(seed))
    cell.run(60.0)
    assert cell.gaps()[-1] < 0.1
    assert not cell.oracle.refusals and not cell.oracle.burials
    assert all(vehicle.attempts == 0 for vehicle in cell.vehicles.values())
    assert cell.oracle.checks > 60 * len(cell.vehicles)


@pytest.mark.parametrize("seed", SEEDS)
def test_every_pose_is_acknowledged_once_or_waits(seed):
    cell = cluster.Cluster(small(seed))
    cell.kill(cell.servers[0])
    cell.run(60.0)
    for key, vehicle in cell.vehicles.items():
        stored = cell.database.heads[key].durable
        assert vehicle.acked <= stored <= vehicle.produced
        # At a message a second no more than two messages' poses are on their way.
        assert vehicle.produced - vehicle.acked <= 2 * P.pose_hz + 1


@pytest.mark.parametrize("ttl,beat", ((10.0, 2.0), (5.0, 1.0), (3.0, 0.6)))
def test_a_takeover_takes_the_ttl_and_its_detection(ttl, beat):
    """A dead server's last beat is at most a beat old at its death. An observer sees
    it at most a beat later, and buries at its first reading a TTL after that."""
    buried = []
    for seed in range(1, 11):
        cell = cluster.Cluster(small(seed, streams=4, parameters=dataclasses.replace(
            P, ttl_s=ttl, beat_s=beat)))
        cell.run(10.0 + beat * cell.kernel.random.random())
        at = cell.kernel.now
        cell.kill(cell.servers[0])
        cell.run(ttl + 3 * beat + 1.0)
        buried.append(cell.oracle.burials[0] - at)
        assert len(cell.oracle.burials) == 1
    assert ttl - beat <= min(buried)
    assert max(buried) <= ttl + 2 * beat + 0.1
    # The first of three observers sees the last beat after beat / 4 in the mean, and
    # half of the time its reading after the TTL comes a moment too soon; the beat's
    # own age takes half a beat off.
    assert statistics.fmean(buried) == pytest.approx(ttl, abs=beat)


def test_vehicles_of_a_server_that_ends_in_order_are_free_at_once():
    cell = cluster.Cluster(small(1))
    cell.restart(cell.servers[0], 1.0, lambda: None)
    cell.run(20.0)
    assert cell.gaps()[-1] < 3.0
    assert cell.servers[0].joins == 2


def test_a_vehicle_is_handed_over_no_sooner_than_it_was_held():
    cell = cluster.Cluster(small(1, envoys=2, policy=parameters.Policy(
        owner_header=False)))
    cell.envoys[1].cut.add(0)
    cell.call_beside_streams(cell.envoys[1], list(cell.vehicles), 2.0, 4)
    cell.run(120.0)
    assert cell.oracle.handovers > 20
    for times in cell.oracle.owned_at.values():
        for (before, _), (after, _) in zip(times, times[1:]):
            assert after - before >= P.hold_s


def test_envoy_cuts_the_streams_of_a_server_that_hangs_as_their_pings_go_unanswered():
    cell = cluster.Cluster(small(1))
    begun = cell.kernel.now
    cuts = []
    for vehicle in cell.vehicles.values():
        vehicle.cut = lambda server, cut=vehicle.cut: (
            cuts.append(cell.kernel.now - begun), cut(server))
    cell.freeze(cell.servers[0], 20.0)
    cell.run(60.0)
    longest = P.ping_interval_s * (1.0 + P.ping_jitter) + P.ping_timeout_s
    assert len(cuts) == len(cell.vehicles)
    assert P.ping_timeout_s <= min(cuts) < max(cuts) <= longest
    assert statistics.mean(cuts) == pytest.approx(
        P.ping_timeout_s + 0.5 * P.ping_interval_s, rel=0.15)


def test_a_server_that_slept_for_longer_than_its_lease_joins_anew():
    cell = cluster.Cluster(small(1))
    cell.freeze(cell.servers[0], 20.0)
    cell.run(60.0)
    assert cell.waiting() == 0
    assert cell.servers[0].joins == 2


def harm_at_random(seed, policy, lag=None, seconds=100.0, **figures):
    """Kills, sleeps, cuts and restarts, failovers and stalls, one after the other."""
    cell = cluster.Cluster(small(
        seed, streams=20, policy=policy, standby_lag=lag, envoys=2,
        parameters=dataclasses.replace(P, **figures)))
    random_ = random.Random(seed)
    cell.call_beside_streams(cell.envoys[1], list(cell.vehicles)[::4], 2.0, 4)
    end = cell.kernel.now + seconds
    while cell.kernel.now < end:
        cell.run(random_.uniform(1.0, 12.0))
        harmed = random_.choice(cell.servers)
        act = random_.randrange(8)
        if act == 0 and harmed.working:
            cell.kill(harmed)
            cell.kernel.after(random_.uniform(0.5, 15.0), harmed.start)
        elif act == 1:
            cell.freeze(harmed, random_.uniform(1.0, 25.0))
        elif act == 2:
            harmed.partition(random_.uniform(1.0, 25.0))
        elif act == 3 and harmed.working:
            cell.restart(harmed, 1.0, lambda: None)
        elif act == 4:
            cell.fail_over(random_.uniform(0.3, 15.0))
        elif act == 5:
            cell.database.stall_standby(random_.uniform(0.3, 15.0))
        elif act == 6:
            cell.freeze_at_commit(harmed, random_.uniform(1.0, 25.0))
        else:
            cell.envoys[1].cut ^= {random_.randrange(4)}
    for envoy in cell.envoys:
        envoy.cut.clear()
    cell.run(60.0)
    return cell


@pytest.mark.parametrize("policy", (
    parameters.Policy(),
    parameters.Policy(replicated_beats=False),
    parameters.Policy(keep_graph=False, retry_info_rules=False,
                      retry_after_burial=True, load_queue=8)))
@pytest.mark.parametrize("seed", range(1, 6))
def test_no_promise_is_broken_whatever_is_harmed(seed, policy):
    cell = harm_at_random(seed, policy)
    assert cell.waiting() == 0
    assert cell.oracle.checks > 10_000


@pytest.mark.parametrize("seed", range(1, 6))
def test_an_asynchronous_failover_loses_nothing_in_silence(seed):
    cell = harm_at_random(seed, parameters.Policy(), lag=0.5)
    assert cell.waiting() == 0
    assert not cell.oracle.set_back


@pytest.mark.parametrize("seed", SEEDS)
def test_without_the_fence_a_sleep_at_the_worst_place_breaks_a_promise(seed):
    """A check that cannot fail is none."""
    cell = cluster.Cluster(small(seed, policy=parameters.Policy(fence=False)))
    cell.run(5.0)
    cell.freeze_at_commit(cell.servers[0], 20.0)
    with pytest.raises(cluster.Violation):
        cell.run(60.0)


@pytest.mark.parametrize("seed", SEEDS)
def test_with_the_fence_the_same_sleep_does_no_harm(seed):
    cell = cluster.Cluster(small(seed))
    cell.run(5.0)
    cell.freeze_at_commit(cell.servers[0], 20.0)
    cell.run(60.0)
    assert cell.waiting() == 0
    assert cell.database.fenced > 0


@pytest.mark.parametrize("seed", SEEDS)
def test_with_a_lease_longer_than_the_ttl_two_servers_would_answer(seed):
    cell = cluster.Cluster(small(seed, parameters=dataclasses.replace(
        P, lease_margin_s=-10.0)))
    cell.run(5.0)
    cell.servers[0].partition(40.0)
    # What a partitioned server is sent goes elsewhere only if streams do.
    cell.envoys[0].cut.add(0)
    for vehicle in cell.vehicles.values():
        vehicle.cut(cell.servers[0])
    with pytest.raises(cluster.Violation, match="answer"):
        cell.run(40.0)


def wake_without_postgresql(policy):
    """A server sleeps, its vehicles go on elsewhere, and when it wakes PostgreSQL is
    away, so that nobody else serves them and nothing tells it that it is dead. Messages
    are so rare that for some vehicles none waited in it."""
    cell = cluster.Cluster(small(1, policy=policy, message_s=10.0))
    cell.freeze(cell.servers[0], 25.0)
    cell.run(22.0)
    cell.fail_over(15.0)
    cell.run(60.0)
    return cell


def test_a_stream_that_opens_under_a_lease_that_has_run_out_is_refused():
    cell = wake_without_postgresql(parameters.Policy())
    assert cell.oracle.refusals["LEASE_STALE"] > 0
    assert cell.waiting() == 0


def test_without_that_a_stream_would_be_told_less_than_was_acknowledged():
    with pytest.raises(cluster.Violation, match="lost poses"):
        wake_without_postgresql(parameters.Policy(
            lease_to_open=False, leave_without_lease=False))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("leaves", (True, False))
def test_vehicles_of_a_server_without_the_database_go_on_only_if_it_sends_them_away(
        seed, leaves):
    cell = cluster.Cluster(small(seed, policy=parameters.Policy(
        leave_without_lease=leaves)))
    cell.servers[0].partition(60.0)
    # The cut goes on meanwhile.
    cell.run(30.0)
    assert (cell.waiting() == 0) == leaves
    assert (cell.gaps()[-1] < 15.0) == leaves
    cell.run(60.0)
    assert cell.waiting() == 0


# -- PostgreSQL's model


def statement(kernel, done, locks=(), writes=(), log=None):
    def evaluate(store):
        if log is not None:
            log.append((kernel.now, dict(store.handovers)))
        return "result", list(writes)

    return database.Statement(1e-3, locks, evaluate, done)


def test_a_second_writer_of_a_row_sees_what_the_first_has_written():
    kernel = kernels.Kernel(1)
    store = database.Database(kernel, P)
    seen, done = [], []
    for value in (1, 2):
        store.execute(statement(kernel, done.append, (("handovers", 7),),
                                [("handovers", 7, value)], seen))
    kernel.run(1.0)
    assert done == ["result", "result"]
    assert [row for _, row in seen] == [{}, {7: 1}]
    assert store.handovers == {7: 2}


def test_a_synchronous_commit_is_invisible_until_the_standby_has_it():
    kernel = kernels.Kernel(1)
    store = database.Database(kernel, P)
    store.stall_standby(5.0)
    done = []
    store.execute(statement(kernel, done.append, writes=[("handovers", 7, 1)]))
    kernel.run(4.9)
    assert not done and not store.handovers
    kernel.run(5.1)
    assert done and store.handovers == {7: 1}


@pytest.mark.parametrize("seed", SEEDS)
def test_what_a_crash_finds_under_way_is_unknown_and_the_rest_is_kept(seed):
    kernel = kernels.Kernel(seed)
    store = database.Database(kernel, P)
    answers = []
    for key in range(100):
        kernel.after(key * 0.001, store.execute, statement(
            kernel, lambda result, k=key: answers.append((k, result)),
            writes=[("handovers", key, 1)]))
    kernel.run(0.05)
    store.crash(1.0)
    kernel.run(0.5)
    failed = {key: result for key, result in answers if result != "result"}
    assert set(failed) | set(store.handovers) == set(range(100))
    assert any(result.unknown for result in failed.values())
    for key, result in answers:
        if result == "result":
            assert key in store.handovers
        elif not result.unknown:
            assert key not in store.handovers


def test_an_asynchronous_standby_lacks_the_last_commits():
    kernel = kernels.Kernel(1)
    store = database.Database(kernel, P, standby_lag=0.02)
    for key in range(50):
        kernel.after(key * 0.002, store.execute, statement(
            kernel, lambda _: None, writes=[("handovers", key, 1)]))
    kernel.run(0.2)
    for key in range(50, 60):
        store.execute(statement(kernel, lambda _: None,
                                writes=[("handovers", key, 1)]))
    kernel.run(0.21)
    assert len(store.handovers) == 60
    store.crash(1.0)
    assert sorted(store.handovers) == list(range(50))


def test_the_model_of_commits_is_within_a_factor_of_four_of_the_measurement():
    """The machine of the measurement had four to seven times the load that its cores
    could take, so that the model is faster where processors bound it."""
    two_cores = dataclasses.replace(P, database_cores=2, hop_s=0.00005)
    for rows, connections, thousand, _ in parameters.MEASURED_INGEST:
        model = ingest.closed_loop(1, two_cores, connections, rows)
        assert 0.5 <= model / thousand <= 4.0, (rows, connections)


def test_a_claim_skips_what_an_append_under_way_holds():
    cell = cluster.Cluster(small(1, streams=1))
    key, vehicle = next(iter(cell.vehicles.items()))
    owner = next(server for server in cell.servers if server.owns(key))
    other = next(server for server in cell.servers if server is not owner)
    cell.database.servers[owner.incarnation] = dataclasses.replace(
        cell.database.servers[owner.incarnation], live=False)
    results = []
    row = database.Row(key, 1, vehicle.acked + 1, 1)
    # Far away enough that the claim comes between evaluation and commit.
    cell.database.execute(database.append(
        P, owner.incarnation, [row], True, results.append))
    cell.kernel.after(0.0015, cell.database.execute, database.claim(
        P, other.incarnation, [key], results.append))
    cell.kernel.run(cell.kernel.now + 0.05)
    assert {key} in results
    assert ({}, {key: owner.incarnation}) in results


def test_refusals_name_the_owner_and_when_to_come_back():
    cell = cluster.Cluster(small(1, streams=1))
    key = next(iter(cell.vehicles))
    owner = next(server for server in cell.servers if server.owns(key))
    other = next(server for server in cell.servers if server is not owner)
    answers = []
    other.open(key, None, answers.append)
    cell.run(0.1)
    assert isinstance(answers[0], servers.Refusal)
    assert answers[0].reason == "NOT_OWNER"
    assert answers[0].owner == owner.address
    assert 0.0 <= answers[0].retry <= P.not_owner_retry_s
