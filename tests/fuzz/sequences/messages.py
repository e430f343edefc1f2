"""Messages of any type, made by reflection: mostly plausible ones, some with
values at the edges, some that are no messages at all.

What is plausible follows from the names and types of fields; only of poses, and
of the names of resources, more is known here. A new field or method is filled
without work.
"""

import functools
import math
import random

from google.protobuf import message_factory
from google.protobuf.descriptor import FieldDescriptor as Field

from stubs import api

IDS = [f"car-{number}" for number in range(6)]
PAIR_IDS = ["a", "b", "c-1"]

INTEGERS = [0, 1, -1, 2, 63, 64, 255, 256, 4096, 4097, 2**31 - 1, -2**31,
            2**31, 2**32 - 1, 2**53, 2**63 - 2, 2**63 - 1, 2**63, -2**63,
            2**64 - 1]
DOUBLES = [0.0, -0.0, 1.0, -1.0, 1e-3, 0.5, 3.15, 5e-324, 2.3e-308, 1e-18,
           1e6, 1.1e8, 1e9, 1.1e18, 1e154, 1.7976931348623157e308, -1e308,
           math.inf, -math.inf, math.nan]
TEXTS = ["", "a", "-", "vehicles/", "vehicles/-", "vehicles/car-0/",
         "/car-0", "vehicles/CAR-0", "vehicles/" + "x" * 64, "x" * 5000,
         "vehicles/car-0/loopClosures/a/b", "vehicles/../car-0",
         "vehicles/car-0\0", "véhicules/ä", "\x01unread", "%2e%2e", "*",
         "settings", "settings.max_candidates", "sequence", "poses",
         "\u202egnp", "'; DROP TABLE vehicle; --"]

BITS = {Field.CPPTYPE_INT32: (-2**31, 2**31 - 1),
        Field.CPPTYPE_INT64: (-2**63, 2**63 - 1),
        Field.CPPTYPE_UINT32: (0, 2**32 - 1),
        Field.CPPTYPE_UINT64: (0, 2**64 - 1)}


message_class = functools.cache(message_factory.GetMessageClass)


def _kind(vehicle_id):
    """Each vehicle is of another kind, which the end of its name tells."""
    return int(vehicle_id[-1]) if vehicle_id[-1:].isdigit() else 0


def settings_of(vehicle_id):
    settings = {"sequence_length_meters": 8.0, "check_interval_meters": 4.0,
                "node_spacing_meters": 1.0}
    kind = _kind(vehicle_id)
    if kind == 1:
        settings["state_space"] = api.STATE_SPACE_SPATIAL
    elif kind == 2:
        settings["coordinate_frame"] = api.COORDINATE_FRAME_GEODETIC
    elif kind == 3:
        settings["correlation_model"] = api.CORRELATION_MODEL_FILTER
    elif kind == 4:
        settings["alignment"] = api.ALIGNMENT_COMPOSITE
    return settings


@functools.lru_cache(maxsize=20000)
def _pose_of_kind(kind, sequence):
    # Round and round a circle, so that there are candidates.
    angle = sequence / 6.0
    pose = api.Pose(sequence=sequence, heading_radians=angle + math.pi / 2)
    if kind == 2:
        pose.geodetic.latitude_degrees = 43.8 + 5e-5 * math.sin(angle)
        pose.geodetic.longitude_degrees = -79.4 + 7e-5 * math.cos(angle)
    else:
        pose.local.x_meters = 6.0 * math.cos(angle)
        pose.local.y_meters = 6.0 * math.sin(angle)
    if kind == 1:
        pose.covariance.form = api.COVARIANCE_FORM_SPATIAL_10
        pose.covariance.values[:] = [.04, 0, 0, 0, .04, 0, 0, .04, 0, 1e-4]
    else:
        pose.covariance.form = api.COVARIANCE_FORM_PLANAR_6
        pose.covariance.values[:] = [.04, 0, 0, .04, 0, 1e-4]
    if kind == 3 and sequence > 1:
        pose.error_transition[:] = [1, 0, 0, 0, 1, 0, 0, 0, 1]
    if kind != 2 and sequence % 100 == 60:
        # The odometry begins anew.
        start = pose.recording_start
        if sequence % 300 == 60:
            start.unknown = True
        elif sequence % 300 == 160:
            start.after.CopyFrom(pose.covariance)
        else:
            start.datum.covariance.CopyFrom(pose.covariance)
    return pose


def valid_pose(vehicle_id, sequence, rng):
    """The pose that a vehicle has at a place of its stream: the same each time
    that it is asked for, but for a few."""
    pose = api.Pose()
    pose.CopyFrom(_pose_of_kind(_kind(vehicle_id), sequence))
    if rng.random() < 0.005:
        pose.stamp.seconds = rng.randrange(2**31)
    return pose


def is_map(field):
    return field.message_type is not None and \
        field.message_type.GetOptions().map_entry


class World:
    """What the fuzzer has learnt of the server from its answers."""

    def __init__(self):
        self.durable = {}
        self.revision = {}
        self.tokens = []
        self.strings = []
        # By vehicle and name of the field.
        self.named = {}
        # Vehicles that take no writes until somebody accepts that.
        self.lossy = set()

    def learn_failure(self, vehicle_id, info):
        """From why a call was refused."""
        if info.reason == "DURABLE_SEQUENCE_REGRESSED":
            self.lossy.add(vehicle_id)
        elif info.reason == "VEHICLE_NOT_FOUND":
            self.durable.pop(vehicle_id, None)
        for name, less in (("durable_sequence", 0), ("expected_sequence", 1)):
            if name in info.metadata:
                self.durable[vehicle_id] = int(info.metadata[name]) - less

    def learn(self, vehicle_id, message):
        """From the fields of an answer, wherever they are in it."""
        for field, value in message.ListFields():
            if is_map(field):
                continue
            if field.type == Field.TYPE_MESSAGE:
                values = value if field.is_repeated else [value]
                for each in list(values)[:3]:
                    self.learn(vehicle_id, each)
            elif field.name == "durable_sequence":
                self.durable[vehicle_id] = value
            elif field.name == "revision":
                self.revision[vehicle_id] = value
            elif field.name.endswith("_token"):
                self.tokens = [*self.tokens[-30:], value]
            elif field.type == Field.TYPE_STRING and not field.is_repeated:
                self.strings = [*self.strings[-30:], value]
                self.named[vehicle_id, field.name] = value

    def of_that_name(self, vehicle_id, name):
        """What an answer called so, such as the `uid` for a `vehicle_uid`."""
        return self.named.get((vehicle_id, name)) or self.named.get(
            (vehicle_id, name.split("_")[-1]))


class Maker:
    """Makes the messages of one call."""

    def __init__(self, rng, world, vehicle_id, method):
        self.rng, self.world = rng, world
        self.vehicle_id = vehicle_id
        self.method = method
        known = world.durable.get(vehicle_id, 0)
        self.next_sequence = known + 1
        # Calls that speak of poses which are stored already.
        self.stored = "Revis" in method.name
        self.said_vehicle = False

    def chance(self, probability):
        return self.rng.random() < probability

    def requests(self):
        """The messages of the call, in bytes."""
        rng = self.rng
        if not self.method.client_streaming:
            count = 1
        else:
            count = rng.choice([0, 1, 1, 2, 2, 3, 4, 6, 10])
        made = []
        for number in range(count):
            if self.method.client_streaming and made and self.chance(0.12):
                made.append(rng.choice([b"", made[-1], made[0]]))
                continue
            made.append(self.request(number))
        return made

    def request(self, number):
        descriptor = self.method.input_type
        message = self.fill(message_class(descriptor), 0, number)
        while self.chance(0.15):
            self.mutate(message)
        data = message.SerializeToString()
        if self.chance(0.02):
            # A field that nobody has yet.
            data += bytes([0xfa, 0x3f]) + _varint(5) + b"guess"
        return data

    # ---- Plausible values

    def fill(self, make, depth, number=0):
        message = make()
        descriptor = message.DESCRIPTOR
        if descriptor.full_name == "revisit.v1.Pose":
            return self.pose()
        if descriptor.full_name == "revisit.v1.VehicleSettings":
            return self.settings()
        if descriptor.full_name.startswith("google.protobuf."):
            return self.well_known(message)
        chosen = set()
        for oneof in descriptor.oneofs:
            if oneof.name.startswith("_"):
                continue
            # What comes first stands first.
            place = 0 if number == 0 else _later_member(self.rng, oneof.fields)
            if self.chance(0.07):
                place = self.rng.randrange(len(oneof.fields))
            if not self.chance(0.02):
                chosen.add(oneof.fields[place].name)
        for field in descriptor.fields:
            oneof = field.containing_oneof
            if oneof is not None and not oneof.name.startswith("_"):
                if field.name not in chosen:
                    continue
            elif not self.wants(field, depth, number):
                continue
            self.set(message, field, depth)
        return message

    def wants(self, field, depth, number):
        """Whether a field that need not be there is."""
        if field.name in ("vehicle", "parent", "name"):
            return number == 0 or self.chance(0.3)
        if field.name.startswith("expected_"):
            return number == 0 and self.chance(0.3)
        if field.name == "page_token" or field.name.endswith("_uid"):
            return self.chance(0.25)
        if field.name.startswith("acked_"):
            return self.chance(0.04)
        if field.name in ("poses", "loop_closure", "rejected_candidate",
                          "update_mask", "settings", "query_sequence",
                          "matched_sequence", "vehicle_id"):
            return self.chance(0.98)
        return self.chance(0.5 if depth == 0 else 0.25)

    def set(self, message, field, depth):
        if field.is_repeated:
            target = getattr(message, field.name)
            if field.message_type is not None \
                    and field.message_type.full_name == "revisit.v1.Pose":
                target.extend(self.poses())
                return
            if is_map(field):
                key, value = field.message_type.fields
                for _ in range(self.rng.choice([0, 1, 1, 2, 5])):
                    target[self.scalar(key)] = self.scalar(value)
                return
            for _ in range(self.rng.choice([0, 1, 1, 2, 5])):
                if field.type == Field.TYPE_MESSAGE:
                    target.append(self.fill(
                        message_class(field.message_type), depth + 1))
                else:
                    target.append(self.scalar(field))
        elif field.type == Field.TYPE_MESSAGE:
            if depth < 6:
                getattr(message, field.name).CopyFrom(
                    self.fill(message_class(field.message_type), depth + 1))
        else:
            setattr(message, field.name, self.scalar(field))

    def scalar(self, field):
        rng = self.rng
        if field.type == Field.TYPE_STRING:
            return self.text(field)
        if field.type == Field.TYPE_BYTES:
            return rng.randbytes(rng.choice([0, 1, 16]))
        if field.type == Field.TYPE_BOOL:
            return self.chance(0.5)
        if field.type == Field.TYPE_ENUM:
            return rng.choice(field.enum_type.values).number
        if field.cpp_type in BITS:
            return self.integer(field)
        return rng.choice([0.01, 0.05, 0.5, 0.9, 1.0, 2.0, 10.0, 50.0, 150.0])

    def integer(self, field):
        rng = self.rng
        durable = self.world.durable.get(self.vehicle_id, 0)
        if field.name == "query_sequence":
            return rng.randint(min(2, durable), max(2, durable))
        if field.name == "matched_sequence":
            return rng.randint(1, max(1, durable // 2))
        if field.name.endswith("sequence"):
            return rng.choice([0, 1, durable, durable, durable, durable + 1])
        if field.name.endswith("revision"):
            return self.world.revision.get(self.vehicle_id, 1)
        return rng.choice([0, 1, 2, 5, 10, 100])

    def text(self, field):
        rng = self.rng
        owner = field.containing_type.name
        vehicle = f"vehicles/{self.vehicle_id}"
        if field.name in ("vehicle", "parent"):
            return vehicle
        if field.name == "name":
            for kind in ("LoopClosure", "RejectedCandidate"):
                if kind in owner:
                    return (f"{vehicle}/{kind[0].lower()}{kind[1:]}s/"
                            f"{rng.choice(PAIR_IDS)}")
            return vehicle
        if field.name == "vehicle_id":
            return self.vehicle_id
        if owner == "LabelsEntry":
            return rng.choice(["site", "session.a", "north", "Site", ""])
        if field.name.endswith("_id"):
            return rng.choice(PAIR_IDS)
        if field.name.endswith("_token") and self.world.tokens:
            return rng.choice(self.world.tokens)
        told = self.world.of_that_name(self.vehicle_id, field.name)
        if told and self.chance(0.9):
            return told
        if self.world.strings and self.chance(0.3):
            return rng.choice(self.world.strings)
        return rng.choice(TEXTS)

    def well_known(self, message):
        rng = self.rng
        name = message.DESCRIPTOR.name
        if name == "FieldMask":
            inside = rng.choice(api.VehicleSettings.DESCRIPTOR.fields).name
            message.paths.extend(rng.choice(
                [["settings"], [f"settings.{inside}"], ["sequence"],
                 ["labels"], ["display_name", "labels.site"],
                 ["local", "covariance"], [rng.choice(TEXTS)], []]))
        elif name in ("Timestamp", "Duration"):
            message.seconds = rng.randrange(2**31)
            message.nanos = rng.randrange(10**9)
        return message

    def settings(self):
        settings = api.VehicleSettings(**settings_of(self.vehicle_id))
        if self.chance(0.15):
            field = self.rng.choice(settings.DESCRIPTOR.fields)
            self.set(settings, field, 3)
        return settings

    def poses(self):
        rng = self.rng
        count = rng.choice([0, 1, 1, 2, 3, 8, 8, 20, 64])
        if self.stored:
            durable = self.world.durable.get(self.vehicle_id, 0)
            first = rng.randint(1, max(1, durable - count + 1))
        else:
            first = self.next_sequence
            if self.chance(0.1):
                first = max(1, first - rng.randint(0, 40))
            self.next_sequence = first + count
        return [self.pose(sequence)
                for sequence in range(first, first + count)]

    def pose(self, sequence=None):
        if sequence is None:
            sequence = self.next_sequence
        pose = valid_pose(self.vehicle_id, sequence, self.rng)
        if self.stored and pose.HasField("local"):
            pose.local.x_meters += self.rng.gauss(0.0, 0.1)
        return pose

    # ---- Implausible ones

    def mutate(self, message):
        """Changes something somewhere in the message."""
        rng = self.rng
        while True:
            inner = [value for field, value in message.ListFields()
                     if field.type == Field.TYPE_MESSAGE and not is_map(field)
                     and len(value if field.is_repeated else [value]) > 0]
            if not inner or self.chance(0.3):
                break
            chosen = rng.choice(inner)
            message = chosen if hasattr(chosen, "DESCRIPTOR") \
                else rng.choice(chosen)
        fields = message.DESCRIPTOR.fields
        if not fields:
            return
        field = rng.choice(fields)
        if self.chance(0.25):
            message.ClearField(field.name)
        elif is_map(field):
            key, value = field.message_type.fields
            for _ in range(rng.choice([1, 2, 40, 200])):
                getattr(message, field.name)[
                    self.edge(key) + str(rng.randrange(1000))] = \
                        self.edge(value)
        elif field.is_repeated:
            target = getattr(message, field.name)
            if field.type == Field.TYPE_MESSAGE:
                if len(target) > 0 and self.chance(0.5):
                    target.append(rng.choice(target))
                else:
                    self.set(message, field, 4)
            elif self.chance(0.5) and len(target) > 0:
                target[rng.randrange(len(target))] = self.edge(field)
            else:
                target.extend([self.edge(field)] *
                              rng.choice([1, 2, 40, 1000]))
        elif field.type == Field.TYPE_MESSAGE:
            self.set(message, field, 3)
        else:
            setattr(message, field.name, self.edge(field))

    def edge(self, field):
        rng = self.rng
        if field.type == Field.TYPE_STRING:
            return rng.choice(TEXTS)
        if field.type == Field.TYPE_BYTES:
            return rng.randbytes(rng.choice([0, 1, 5000]))
        if field.type == Field.TYPE_BOOL:
            return self.chance(0.5)
        if field.type == Field.TYPE_ENUM:
            return rng.choice([0, 1, 2, 3, 99, -1, 2**31 - 1])
        if field.cpp_type in BITS:
            low, high = BITS[field.cpp_type]
            return min(max(rng.choice(INTEGERS), low), high)
        value = rng.choice(DOUBLES)
        if field.cpp_type == Field.CPPTYPE_FLOAT and abs(value) > 3e38:
            value = math.inf
        return value


def _later_member(rng, fields):
    """A member of a oneof for messages after the first."""
    return rng.randrange(1, len(fields)) if len(fields) > 1 else 0


def _varint(value):
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    out.append(value)
    return bytes(out)


def spoil(rng, data):
    """Bytes that are most likely no message."""
    choice = rng.randrange(4)
    if choice == 0:
        return rng.randbytes(rng.choice([1, 3, 17, 200]))
    if choice == 1 and len(data) > 1:
        return data[:rng.randrange(1, len(data))]
    if choice == 2 and data:
        at = rng.randrange(len(data))
        return data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) \
            + data[at + 1:]
    # Nested without end.
    return b"\x0a\x7f" * rng.choice([1, 200, 5000])


def seeded(seed, number):
    return random.Random(f"{seed} {number}")
