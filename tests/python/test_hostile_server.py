"""A server that means harm neither keeps a program waiting for ever nor reaches its
terminal."""

import time

import grpc
import pytest
from google.protobuf import duration_pb2
from google.rpc import error_details_pb2, status_pb2

import revisit
from conftest import LONG, straight
from fake_service import Fault, FakeService, serving
from revisit import BackoffOptions, StreamOptions
from revisit.errors import LONGEST_RETRY_DELAY, from_rpc_error

QUICK = BackoffOptions(initial=0.01, max=0.05)
Code = grpc.StatusCode
HOSTILE = ("\x1b]0;x\x07\x1b[2J\r\n\x7f\x9b31m\u202e\u2066\u200b\u200d\ufeff\u2028"
           "\U000e0041\U000e0100\ufe0f\u3164end")
SHOWN = ("<U+001B>]0;x<U+0007><U+001B>[2J<U+000D><U+000A><U+007F><U+009B>31m<U+202E>"
         "<U+2066><U+200B><U+200D><U+FEFF><U+2028><U+E0041><U+E0100><U+FE0F><U+3164>end")
LONGEST = 315_576_000_000


@pytest.mark.parametrize(("seconds", "nanos", "taken"), [
    (0, 0, 0.0), (2, 500_000_000, 2.5), (300, 1, LONGEST_RETRY_DELAY),
    (9_000_000_000, 0, LONGEST_RETRY_DELAY),
    (LONGEST, 999_999_999, LONGEST_RETRY_DELAY),
    (2**63 - 1, 2**31 - 1, LONGEST_RETRY_DELAY), (-1, 0, 0.0), (0, -1, 0.0),
    (-LONGEST, -999_999_999, 0.0), (-2**63, -2**31, 0.0)])
def test_no_wait_is_longer_than_the_longest_or_shorter_than_none(seconds, nanos, taken):
    fault = Fault(Code.UNAVAILABLE, retry=duration_pb2.Duration(
        seconds=seconds, nanos=nanos))
    with serving(FakeService(fault)) as address, \
            revisit.Client(address, max_attempts=1) as client:
        with pytest.raises(revisit.Unavailable) as caught:
            client.get_vehicle("a")
    assert caught.value.retry_delay == taken


def test_calls_and_streams_do_not_wait_beyond_their_time():
    fault = Fault(Code.RESOURCE_EXHAUSTED, retry=duration_pb2.Duration(
        seconds=9_000_000_000))
    begun = time.monotonic()
    with serving(FakeService(fault, fault)) as address, \
            revisit.Client(address, backoff=QUICK) as client:
        with pytest.raises(revisit.ResourceExhausted):
            client.get_vehicle("a")
        stream = client.stream_poses("a", StreamOptions(backoff=QUICK,
                                                        give_up_after=1.0))
        with pytest.raises(revisit.ResourceExhausted):
            stream.append(straight(3))
            stream.finish()
    assert time.monotonic() - begun < LONG


class _Raised:
    """A grpc.RpcError of a server that says this wherever it can."""

    def code(self):
        return Code.NOT_FOUND

    def details(self):
        return HOSTILE

    def trailing_metadata(self):
        status = status_pb2.Status()
        status.details.add().Pack(error_details_pb2.ErrorInfo(reason=HOSTILE))
        status.details.add().Pack(error_details_pb2.BadRequest(field_violations=[
            error_details_pb2.BadRequest.FieldViolation(field=HOSTILE,
                                                        description=HOSTILE)]))
        return (("grpc-status-details-bin", status.SerializeToString()),)


def test_what_a_server_says_is_shown_for_a_terminal():
    error = from_rpc_error(_Raised())
    assert str(error) == (f"NOT_FOUND ({SHOWN}): {SHOWN}\n  {SHOWN}: {SHOWN}")
    assert repr(error).isprintable()
    # Programs get it as it came.
    assert (error.message, error.reason) == (HOSTILE, HOSTILE)


def test_text_of_any_script_is_shown_as_it_is():
    for text in ("caf\u00e9", "\u0645\u062d\u0637\u0629", "\u5317\u4eac\u3000",
                 "\U0001f697"):
        assert str(revisit.NotFound(text)) == f"NOT_FOUND: {text}"


ENDLESS = {
    "the page again": lambda first, last: lambda token: ([first], "same"),
    "the page again under fresh tokens":
        lambda first, last: lambda token: ([first], token + "x"),
    "two pages in turn":
        lambda first, last: lambda token: (
            [first] if token != "b" else [last], "b" if token != "b" else "a"),
    "empty pages under fresh tokens":
        lambda first, last: lambda token: ([], token + "x"),
    "pages that go back": lambda first, last: lambda token: ([last, first], "x"),
}


@pytest.mark.parametrize("pages", ENDLESS)
def test_a_list_that_does_not_go_on_ends_with_an_error(pages):
    fake = FakeService()
    with serving(fake) as address, revisit.Client(address) as client:
        fake.pages = ENDLESS[pages]("vehicles/a", "vehicles/b")
        with pytest.raises(revisit.Internal, match="does not go on"):
            list(client.list_vehicles())
        fake.pages = ENDLESS[pages](1, 2)
        with pytest.raises(revisit.Internal, match="does not go on"):
            list(client.list_poses("a"))
        assert fake.calls < 250


def test_a_list_may_have_some_empty_pages():
    fake = FakeService()
    tokens = [str(number) for number in range(150)]

    def pages(token):
        place = tokens.index(token) if token else 0
        names = [f"vehicles/v{place:03}"] if place % 50 == 49 else []
        return names, tokens[place + 1] if place + 1 < len(tokens) else ""

    fake.pages = pages
    with serving(fake) as address, revisit.Client(address) as client:
        assert [vehicle.name for vehicle in client.list_vehicles()] == [
            "vehicles/v049", "vehicles/v099", "vehicles/v149"]
