"""Scenarios: what one connection does, step by step. A scenario is plain data,
so that it can be kept, run again, and made smaller."""

import base64
import copy
import json
import struct

from google.protobuf.message import DecodeError

from messages import IDS, Maker, message_class, spoil
from raw_http2 import call_headers
from stubs import api

SERVICE = api.GetServerInfoRequest.DESCRIPTOR.file.services_by_name[
    "PoseGraphService"]
METHODS = list(SERVICE.methods)
BY_NAME = SERVICE.methods_by_name
# Streams are where sequences matter.
WEIGHTS = [8 if method.client_streaming else
           4 if method.server_streaming else
           0.3 if method.name.startswith("Delete") else 1
           for method in METHODS]

REQUEST_IDS = ["", "one", "x" * 128, "x" * 129, "a b", "\x7f", "%", "\"\\"]
TIMEOUTS = ["1n", "100u", "1m", "20m", "5S"]
RESET_CODES = [8, 8, 8, 0, 2, 7, 0xffffffff]


class Call:
    def __init__(self, method, vehicle_id, path, identity):
        self.method, self.vehicle_id = method, vehicle_id
        self.path, self.identity = path, identity
        self.extra = []
        # Whether more than the contents of messages is wrong.
        self.bad_framing = False
        # Whether a message is no protobuf, or there are not as many as the
        # method takes.
        self.bad_message = False

    def headers(self, token):
        extra = list(self.extra)
        if token:
            extra.append(("authorization", f"Bearer {token}"))
        return call_headers(path=self.path, extra=extra)


class Scenario:
    def __init__(self):
        self.calls = []
        # (what, call or None, argument)
        self.steps = []
        self.receive_window = 2**31 - 1
        # Whether the connection is made for it.
        self.fresh = False
        # Whether frames are sent that end the connection.
        self.hostile = False

    def without(self, *, call=None, step=None):
        """A smaller one."""
        smaller = copy.copy(self)
        if call is not None:
            smaller.steps = [each for each in self.steps if each[1] != call]
        else:
            smaller.steps = self.steps[:step] + self.steps[step + 1:]
        return smaller

    def lines(self):
        """For people."""
        for what, number, argument in self.steps:
            if number is None:
                yield f"{what} {argument!r}"
                continue
            call = self.calls[number]
            if what == "open":
                yield (f"call {number}: {call.path.split('/')[-1]} as "
                       f"{call.identity} {call.extra}")
            elif what == "send":
                shown = _shown(call.method, argument)
                yield f"call {number}: send {shown}"
            else:
                yield f"call {number}: {what} {argument}"

    def to_json(self):
        return {
            "calls": [{"method": call.method.name, "path": call.path,
                       "vehicle_id": call.vehicle_id,
                       "identity": call.identity, "extra": call.extra,
                       "bad_framing": call.bad_framing,
                       "bad_message": call.bad_message}
                      for call in self.calls],
            "steps": [[what, number, {"bytes": base64.b64encode(
                argument).decode()} if isinstance(argument, bytes)
                else argument] for what, number, argument in self.steps],
            "receive_window": self.receive_window, "fresh": self.fresh,
            "hostile": self.hostile}

    @classmethod
    def from_json(cls, data):
        made = cls()
        for fields in data["calls"]:
            call = Call(BY_NAME[fields["method"]], fields["vehicle_id"],
                        fields["path"], fields["identity"])
            call.extra = [tuple(pair) for pair in fields["extra"]]
            call.bad_framing = fields["bad_framing"]
            call.bad_message = fields["bad_message"]
            made.calls.append(call)
        made.steps = [
            (what, number, base64.b64decode(argument["bytes"])
             if isinstance(argument, dict) else argument)
            for what, number, argument in data["steps"]]
        made.receive_window = data["receive_window"]
        made.fresh, made.hostile = data["fresh"], data["hostile"]
        return made


def _shown(method, data):
    try:
        message = message_class(method.input_type).FromString(data[5:])
    except DecodeError:
        return f"{data[:80]!r} ({len(data)} bytes, no {method.input_type.name})"
    text = str(message).replace("\n", " ")
    if len(text) > 600:
        text = text[:600] + f"... ({len(data)} bytes)"
    return f"{method.input_type.name} {{{text}}}"


def save(path, scenarios):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps([each.to_json() for each in scenarios]))


def load(path):
    return [Scenario.from_json(data) for data in json.loads(path.read_text())]


def make(rng, world, identities):
    """A new one; `identities` are the names of those who may call."""
    scenario = Scenario()
    scenario.fresh = rng.random() < 0.1
    if rng.random() < 0.02:
        # A reader that is slow, or stands still.
        scenario.fresh = True
        scenario.receive_window = rng.choice([0, 1, 100, 5000])
    vehicles = rng.sample(IDS, 2)
    scripts = []
    for number in range(rng.choice([1, 1, 2, 3, 4, 6])):
        identity = rng.choice(identities)
        vehicle = rng.choice(vehicles)
        if identity and identity != "operator":
            # Most often its own tenant's.
            vehicle = f"{identity if rng.random() < 0.9 else 'umbra'}-{vehicle}"
        call, script = _script(rng, world, number, vehicle, identity)
        scenario.calls.append(call)
        scripts.append(script)
    # Calls that go on side by side.
    while scripts:
        script = rng.choice(scripts)
        for _ in range(rng.choice([1, 2, 100])):
            if script:
                scenario.steps.append(script.pop(0))
        if not script:
            scripts.remove(script)
    if rng.random() < 0.04:
        scenario.steps.insert(rng.randrange(len(scenario.steps) + 1),
                              ("close", None, rng.random() < 0.5))
    if rng.random() < 0.01:
        scenario.hostile = True
        scenario.steps.insert(rng.randrange(len(scenario.steps) + 1),
                              ("raw", None, rng.randbytes(64)))
    return scenario


def _script(rng, world, number, vehicle, identity):
    """One call, and its steps."""
    method = rng.choices(METHODS, WEIGHTS)[0]
    if vehicle not in world.durable and rng.random() < 0.9:
        method = BY_NAME["CreateVehicle"]
        world.durable[vehicle] = 0
    elif vehicle in world.lossy and rng.random() < 0.5:
        method = BY_NAME["AcceptDataLoss"]
        world.lossy.discard(vehicle)
    call = Call(method, vehicle, f"/{SERVICE.full_name}/{method.name}",
                identity)
    if rng.random() < 0.005:
        call.path += "s"
        call.bad_framing = True
    if rng.random() < 0.05:
        call.extra.append(("x-request-id", rng.choice(REQUEST_IDS)))
    if rng.random() < 0.04:
        call.extra.append(("grpc-timeout", rng.choice(TIMEOUTS)))
    requests = Maker(rng, world, vehicle, method).requests()
    if not method.client_streaming and rng.random() < 0.01:
        requests = requests * rng.choice([0, 2])
        call.bad_message = True
    steps = [("open", number, None)]
    for place, data in enumerate(requests):
        if rng.random() < 0.015:
            data = spoil(rng, data)
            call.bad_message = True
        framed = struct.pack(">BI", 0, len(data)) + data
        if rng.random() < 0.004:
            call.bad_framing = True
            framed = rng.choice([
                # Compressed, in which way nobody said.
                b"\1" + framed[1:], b"\7" + framed[1:],
                # Longer than it is, and than anything may be.
                struct.pack(">BI", 0, len(data) + 7) + data,
                struct.pack(">BI", 0, 2**32 - 1) + data, framed[:-1]])
        steps.append(("send", number, framed))
        if method.client_streaming and method.server_streaming \
                and rng.random() < (0.6 if place == 0 else 0.2):
            steps.append(("await", number, place + 1))
    end = rng.random()
    if end < 0.8 or not method.client_streaming:
        steps.append(("half-close", number, None))
        if method.name == "WatchCandidates":
            # Ends by itself only where it is refused.
            steps.append(("await", number, 1))
            steps.append(("reset", number, rng.choice(RESET_CODES)))
        elif rng.random() < 0.4:
            steps.append(("await", number, None))
    if end > 0.9:
        steps.insert(rng.randrange(1, len(steps) + 1),
                     ("reset", number, rng.choice(RESET_CODES)))
    return call, steps
