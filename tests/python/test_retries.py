"""Calls and streams are made again where docs/integrate.md says so, not sooner than
the server asks, and nowhere else."""

import threading
import time

import grpc
import pytest

import revisit
from conftest import LONG, straight
from fake_service import Fault, FakeService, serving
from revisit import BackoffOptions, StreamCallbacks, StreamOptions

QUICK = BackoffOptions(initial=0.01, max=0.05)
Code = grpc.StatusCode

PASSING = [
    Fault(Code.UNAVAILABLE),
    Fault(Code.UNAVAILABLE, reason="OVERLOADED", retry=0.05),
    Fault(Code.INTERNAL),
    Fault(Code.CANCELLED),
]
EXHAUSTED = Fault(Code.RESOURCE_EXHAUSTED, reason="QUEUE_FULL", retry=0.05)
LASTING = [
    Fault(Code.INTERNAL, reason="INTERNAL"),
    Fault(Code.CANCELLED, reason="CANCELLED"),
    Fault(Code.RESOURCE_EXHAUSTED, reason="STREAM_QUOTA"),
    Fault(Code.NOT_FOUND, reason="VEHICLE_NOT_FOUND"),
    Fault(Code.UNAUTHENTICATED, reason="CREDENTIALS_INVALID"),
]


def name_of(fault):
    return f"{fault.code.name}-{fault.reason}"


@pytest.mark.parametrize("fault", [*PASSING, EXHAUSTED], ids=name_of)
def test_a_safe_call_is_made_again(fault):
    fake = FakeService(fault, fault)
    with serving(fake) as address, revisit.Client(address, backoff=QUICK) as client:
        assert client.get_vehicle("a").name == "vehicles/a"
    assert fake.calls == 3
    # All attempts are one call in the server's log.
    assert len({call["x-request-id"] for call in fake.metadata}) == 1


@pytest.mark.parametrize("fault", LASTING, ids=name_of)
def test_what_will_not_pass_is_not_repeated(fault):
    fake = FakeService(fault)
    with serving(fake) as address, revisit.Client(address, backoff=QUICK) as client:
        with pytest.raises(revisit.Error) as caught:
            client.get_vehicle("a")
    assert fake.calls == 1
    assert (caught.value.code, caught.value.reason) == (fault.code, fault.reason)


def test_a_deletion_is_repeated_only_if_the_server_did_nothing():
    for fault in PASSING:
        fake = FakeService(fault)
        with serving(fake) as address, revisit.Client(address) as client:
            with pytest.raises(revisit.Error):
                client.delete_vehicle("a")
        assert fake.calls == 1
    fake = FakeService(EXHAUSTED)
    with serving(fake) as address, revisit.Client(address, backoff=QUICK) as client:
        client.delete_vehicle("a")
    assert fake.calls == 2


NOT_OWNER = Fault(Code.UNAVAILABLE, reason="NOT_OWNER",
                  metadata={"owner": "10.0.0.2:50051"})
FENCED = Fault(Code.ABORTED, reason="EPOCH_FENCED")
# The address in base64, as Envoy's stateful sessions read it.
ROUTE = "MTAuMC4wLjI6NTAwNTE="


def routes(fake):
    return [call.get("x-revisit-owner", "") for call in fake.metadata]


def test_a_call_goes_to_the_owner_of_its_vehicle_also_if_it_may_be_made_once_only():
    fake = FakeService(NOT_OWNER, FENCED)
    with serving(fake) as address, revisit.Client(address, backoff=QUICK) as client:
        client.delete_vehicle("a")
        client.get_vehicle("a")
    assert routes(fake) == ["", ROUTE, "", ""]


def test_a_vehicle_that_is_elsewhere_is_followed_until_the_deadline():
    fake = FakeService(*[NOT_OWNER] * 20)
    with serving(fake) as address, revisit.Client(address, backoff=QUICK) as client:
        assert client.get_vehicle("a").name == "vehicles/a"
    assert fake.calls == 21


def test_a_stream_goes_to_the_owner_of_its_vehicle_with_every_pose():
    fake = FakeService(NOT_OWNER, FENCED)
    with serving(fake) as address, revisit.Client(address) as client:
        with client.stream_poses("a", StreamOptions(backoff=QUICK)) as stream:
            stream.append(straight(200))
            stream.finish()
    assert routes(fake) == ["", ROUTE, ""]
    assert len(fake.stored) == 200


def test_a_revision_is_repeated_only_with_the_revision_it_started_from():
    fake = FakeService(PASSING[0])
    with serving(fake) as address, revisit.Client(address, backoff=QUICK) as client:
        with pytest.raises(revisit.Unavailable):
            client.revise_poses("a", straight(2500).to_messages())
        fake.faults = [PASSING[0]]
        answer = client.revise_poses("a", straight(2500).to_messages(), 7)
    assert answer.revised_count == 2500
    assert fake.calls == 3


def test_a_retry_waits_as_long_as_the_server_asks():
    fake = FakeService(Fault(Code.UNAVAILABLE, reason="OVERLOADED", retry=0.4))
    with serving(fake) as address, revisit.Client(address, backoff=QUICK) as client:
        begun = time.monotonic()
        client.get_vehicle("a")
        assert time.monotonic() - begun >= 0.4


def test_no_retry_waits_beyond_the_deadline():
    fake = FakeService(Fault(Code.UNAVAILABLE, reason="OVERLOADED", retry=50))
    with serving(fake) as address, revisit.Client(
            address, deadline=40.0, backoff=QUICK) as client:
        begun = time.monotonic()
        with pytest.raises(revisit.Unavailable) as caught:
            client.get_vehicle("a")
        assert time.monotonic() - begun < 30.0
    assert caught.value.retry_delay == 50.0
    assert caught.value.metadata == {"limit": "7"}


def test_attempts_are_counted():
    fake = FakeService(*[PASSING[0]] * 10)
    with serving(fake) as address, revisit.Client(
            address, max_attempts=3, backoff=QUICK) as client:
        with pytest.raises(revisit.Unavailable):
            client.get_vehicle("a")
    assert fake.calls == 3


@pytest.mark.parametrize("fault", [
    *PASSING, EXHAUSTED, Fault(Code.ABORTED, reason="REVISION_MISMATCH"),
    Fault(Code.UNAUTHENTICATED, reason="TOKEN_EXPIRED")], ids=name_of)
def test_a_stream_goes_on_after(fault):
    fake = FakeService(fault, fault)
    lost, resumed = [], []
    callbacks = StreamCallbacks(
        disconnected=lambda error, wait: lost.append((error, wait)),
        resumed=resumed.append)
    with serving(fake) as address, revisit.Client(address) as client:
        with client.stream_poses("a", StreamOptions(backoff=QUICK),
                                 callbacks) as stream:
            stream.append(straight(10))
    assert fake.stored == list(range(1, 11))
    assert [error.reason for error, _ in lost] == [fault.reason] * 2
    assert all(wait >= (fault.retry or 0.0) for _, wait in lost)
    assert resumed == [0, 0]
    assert [one.vehicle_uid for one in fake.opens] == ["", "one", "one"]


@pytest.mark.parametrize("fault", LASTING, ids=name_of)
def test_a_stream_ends_with(fault):
    fake = FakeService(fault)
    with serving(fake) as address, revisit.Client(address) as client:
        with pytest.raises(revisit.Error) as caught:
            with client.stream_poses("a") as stream:
                stream.append(straight(10))
    assert (caught.value.code, caught.value.reason) == (fault.code, fault.reason)
    assert stream.reconnects == 0


def test_a_stream_says_what_it_knows_to_be_durable_when_it_resumes():
    fake = FakeService()
    with serving(fake) as address, revisit.Client(address) as client:
        with client.stream_poses("a", StreamOptions(
                backoff=QUICK, batch_poses=4)) as stream:
            stream.append(straight(8))
            while stream.acked_sequence < 8:
                time.sleep(0.001)
            fake.faults = [PASSING[0]]
            stream.append(straight(2, first=9))
    assert [one.acked_sequence for one in fake.opens] == [0, 8]
    assert fake.stored == list(range(1, 11))


class Deaf:
    """Channels to a server whose end gRPC misses: a call neither answers nor ends,
    not even if it is cancelled."""

    def __init__(self):
        self.calls = 0
        self.cancelled = 0
        self.forgotten = threading.Event()

    def __iter__(self):
        return self

    def __next__(self):
        self.forgotten.wait(LONG)
        raise StopIteration

    def cancel(self):
        self.cancelled += 1


def test_a_call_that_grpc_forgets_is_left_behind(monkeypatch):
    """The watchdog does not wait for the end of a call that never ends."""
    monkeypatch.setattr("revisit._engine.CANCEL_SECONDS", 0.1)
    deaf = Deaf()

    class Stub:
        def StreamPoses(self, requests, metadata):
            deaf.calls += 1
            return deaf

    monkeypatch.setattr("revisit._engine.stub_of", lambda channel: Stub())
    with revisit.Client("127.0.0.1:1") as client:
        stream = client.stream_poses("a", StreamOptions(
            backoff=QUICK, answer_timeout=0.1, give_up_after=1.0))
        with pytest.raises(revisit.Unavailable, match="no answer for 0.1 s"):
            stream.finish()
        assert deaf.calls == deaf.cancelled > 1
        deaf.forgotten.set()
