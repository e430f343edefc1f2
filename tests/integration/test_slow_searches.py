"""One vehicle's slow searches, and everybody else."""

import time

import grpc
import pytest

from revisit_server import Server
from stubs import api
from wire import PoseStream, append, get, laps

SETTINGS = api.VehicleSettings(node_spacing_meters=0.5,
                               sequence_length_meters=20.0)
# A thousand nodes, which is the most.
LONGEST = 500.0
MOST_POSES = 40000
# Longer than a few acknowledgements on a machine that is busy.
SLOW_SECONDS = 1.0


@pytest.fixture(name="server")
def two_searches_at_a_time(tmp_path):
    with Server(tmp_path / "store", "--worker-threads", 1,
                "--search-threads", 2) as running:
        yield running
        assert running.is_running(), running.log()


def create(stub, name):
    return stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id=name, vehicle=api.Vehicle(settings=SETTINGS))).vehicle.name


def search(vehicle, length_meters):
    return api.FindCandidatesRequest(
        vehicle=vehicle, options=api.CandidateOptions(
            alignment=api.ALIGNMENT_COMPOSITE,
            sequence_length_meters=length_meters))


def make_slow(stub, vehicles):
    """Drives the vehicles on until a search of theirs is slow, however fast
    the machine; answers how long it takes."""
    count = 0
    while count < MOST_POSES:
        # Twenty nodes a pose.
        more = laps(4000, radius=600.0, spacing=10.0, first=count + 1)
        count += len(more)
        for vehicle in vehicles:
            append(stub, vehicle, more)
        begin = time.monotonic()
        stub.FindCandidates(search(vehicles[0], LONGEST))
        seconds = time.monotonic() - begin
        if seconds > SLOW_SECONDS:
            return seconds
    pytest.skip("no search is slow on this machine")


def test_poses_of_others_are_acknowledged_while_vehicles_search(server):
    stub = server.stub()
    slow = [create(stub, f"slow-{i}") for i in range(2)]
    other = create(stub, "other")
    append(stub, other, laps(10))
    make_slow(stub, slow)
    with PoseStream(stub, other) as stream:
        stream.receive_kind("opened")
        # As many at once as there are threads for them.
        searches = [stub.FindCandidates.future(search(vehicle, LONGEST))
                    for vehicle in slow]
        for sequence in range(11, 16):
            stream.send(laps(1, first=sequence))
            assert stream.receive_kind("ack").durable_sequence == sequence
        # And what is read without a search is answered.
        assert get(stub, other).durable_sequence == 15
        assert not any(one.done() for one in searches)
        for one in searches:
            one.result()


def test_search_that_is_given_up_frees_its_thread(server):
    stub = server.stub()
    vehicle = create(stub, "slow")
    seconds = make_slow(stub, [vehicle])
    calls = [stub.FindCandidates.future(search(vehicle, LONGEST), timeout=0.2)
             for _ in range(20)]
    for call in calls:
        assert call.exception().code() == grpc.StatusCode.DEADLINE_EXCEEDED
    begin = time.monotonic()
    stub.FindCandidates(search(vehicle, 10.0))
    # Twenty that ran to their end would take that much longer.
    assert time.monotonic() - begin < 10 * seconds
