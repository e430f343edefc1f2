"""What all tests from outside share."""

import itertools

import pytest

from caller_poses import STORED, good_pose
from revisit_server import Server
from stubs import api
from wire import append, as_bytes, get, list_poses


def pytest_addoption(parser):
    parser.addoption("--seed", type=int, default=20101018,
                     help="of all random choices")
    parser.addoption("--kills", type=int, default=50,
                     help="how often the durability test kills the server")


def pytest_configure(config):
    config.addinivalue_line(
        "markers", "release_build: needs a build that is optimised and not "
        "instrumented, for the time or the memory it takes")


def pytest_report_header(config):
    return f"seed {config.getoption('--seed')}"


@pytest.fixture
def seed(request):
    value = request.config.getoption("--seed")
    # Shown with a failure.
    print(f"seed {value}")
    return value


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """One server for all tests of a file that do not stop it."""
    with Server(tmp_path_factory.mktemp("server") / "store") as running:
        yield running
        assert running.is_running(), running.log()


@pytest.fixture(scope="module")
def stub(server):
    return server.stub()


@pytest.fixture(scope="module")
def new_vehicle(stub):
    """Creates a vehicle of its own for a test; answers its name."""
    numbers = itertools.count(1)

    def create(**settings):
        response = stub.CreateVehicle(api.CreateVehicleRequest(
            vehicle_id=f"vehicle-{next(numbers)}",
            vehicle=api.Vehicle(settings=api.VehicleSettings(**settings))))
        return response.vehicle.name

    return create


@pytest.fixture
def filled(stub, new_vehicle):
    """Makes a vehicle with a few poses."""
    def make(settings):
        vehicle = new_vehicle(**settings)
        append(stub, vehicle, [good_pose(n, settings)
                               for n in range(1, STORED + 1)])
        return vehicle
    return make


@pytest.fixture
def unchanged(stub):
    """Checks at the end that vehicles are as they were."""
    before = {}

    def watch(vehicle):
        before[vehicle] = (get(stub, vehicle),
                           as_bytes(list_poses(stub, vehicle)))
        return vehicle

    yield watch
    for vehicle, (summary, poses) in before.items():
        assert get(stub, vehicle) == summary
        assert as_bytes(list_poses(stub, vehicle)) == poses
