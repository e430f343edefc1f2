"""The display name and the labels of vehicles: what is kept, changed and refused."""

import grpc
import pytest
from google.protobuf import field_mask_pb2

from revisit_server import Server
from stubs import api
from test_hostile_names import HOSTILE
from wire import append, failure_of, get, straight

INVALID = grpc.StatusCode.INVALID_ARGUMENT
LABELS = {"session.2026-11-22": "1-2068", "fleet": "north",
          "example.com/vin": "WDB1234567890", "empty": ""}


def create(stub, vehicle_id, **fields):
    return stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id=vehicle_id, vehicle=api.Vehicle(**fields))).vehicle


def update(stub, vehicle, paths, **fields):
    return stub.UpdateVehicle(api.UpdateVehicleRequest(
        vehicle=api.Vehicle(name=vehicle, **fields),
        update_mask=field_mask_pb2.FieldMask(paths=paths))).vehicle


def test_vehicle_is_created_and_listed_with_name_and_labels(stub):
    made = create(stub, "named", display_name="Sh\u00fcttle 7", labels=LABELS)
    assert made.display_name == "Sh\u00fcttle 7"
    assert dict(made.labels) == LABELS
    assert get(stub, made.name) == made
    listed = {vehicle.name: vehicle for vehicle in
              stub.ListVehicles(api.ListVehiclesRequest()).vehicles}
    assert dict(listed[made.name].labels) == LABELS
    assert listed[made.name].display_name == "Sh\u00fcttle 7"


def test_creating_again_compares_settings_only_and_changes_nothing(stub):
    made = create(stub, "again", display_name="A", labels={"a": "1"})
    for fields in ({}, {"display_name": "B"}, {"labels": {"b": "2"}}):
        assert create(stub, "again", **fields) == made
    failure = failure_of(lambda: create(
        stub, "again", settings=api.VehicleSettings(max_candidates=9)))
    assert failure.reason == "VEHICLE_EXISTS"


def test_update_changes_only_what_it_names(stub):
    made = create(stub, "updated", display_name="A", labels=LABELS)
    append(stub, made.name, straight(5))
    before = get(stub, made.name)
    # A label, and what the request holds besides is not named.
    after = update(stub, made.name, ["labels.session.2026-11-23"],
                   display_name="B", labels={
                       "session.2026-11-23": "2069-3000", "other": "x"})
    assert dict(after.labels) == {**LABELS, "session.2026-11-23": "2069-3000"}
    assert after.display_name == "A"
    assert after.revision > before.revision
    assert after.settings == before.settings
    assert after.node_count == before.node_count
    # Named and absent: removed.
    after = update(stub, made.name, ["labels.fleet", "labels.none"])
    assert "fleet" not in after.labels and len(after.labels) == len(LABELS)
    after = update(stub, made.name, ["display_name"], display_name="C")
    assert (after.display_name, len(after.labels)) == ("C", len(LABELS))
    # A setting leaves both alone.
    after = update(stub, made.name, ["settings.max_candidates"],
                   settings=api.VehicleSettings(max_candidates=9))
    assert (after.display_name, len(after.labels)) == ("C", len(LABELS))
    after = update(stub, made.name, ["labels", "display_name"],
                   labels={"only": "this"})
    assert dict(after.labels) == {"only": "this"}
    assert after.display_name == ""
    assert after.settings.max_candidates == 9
    assert get(stub, made.name) == after


@pytest.mark.parametrize("key", [
    "", "A", "-a", "a-", ".a", "a.", "a b", "\u00e9", "a" * 64, "a\n", "a:b"],
    ids=repr)
def test_key_of_a_label_must_be_one(key, stub):
    made = create(stub, "keys", labels={"a": "1"})
    calls = [lambda: create(stub, "no-such-key", labels={key: "x"}),
             lambda: update(stub, made.name, ["labels"], labels={key: "x"})]
    if key:
        calls.append(lambda: update(stub, made.name, [f"labels.{key}"],
                                    labels={key: "x"}))
    for call in calls:
        failure = failure_of(call)
        assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
        assert set(failure.fields) == {"vehicle.labels"}
        assert "lower-case letters" in failure.message
    assert get(stub, made.name) == made
    assert failure_of(lambda: get(
        stub, "vehicles/no-such-key")).reason == "VEHICLE_NOT_FOUND"


@pytest.mark.parametrize("fields, field", [
    ({"display_name": "a" * 257}, "vehicle.display_name"),
    ({"display_name": "\u00e9" * 129}, "vehicle.display_name"),
    ({"display_name": "two\nlines"}, "vehicle.display_name"),
    ({"labels": {"a": "b" * 129}}, "vehicle.labels.a"),
    ({"labels": {"a": "tab\t"}}, "vehicle.labels.a"),
    ({"labels": {f"key-{n}": "" for n in range(129)}}, "vehicle.labels"),
], ids=["long name", "long in bytes", "lines", "long value", "tab", "many"])
def test_name_and_labels_are_bounded(fields, field, stub):
    failure = failure_of(lambda: create(stub, "bounded", **fields))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert failure.fields == [field]


@pytest.mark.parametrize("text, said", [
    ("colour\x1b[31m", "U+001B at byte 6"), ("8 bits\x9b31m", "U+009B at byte 6"),
    ("\x7f", "U+007F at byte 0"), ("\u00e9\u202egpj.exe", "U+202E at byte 2"),
    ("isolate\u2066", "U+2066 at byte 7"), ("mark\u200e", "U+200E at byte 4"),
    ("mark\u200f", "U+200F at byte 4"), ("mark\u061c", "U+061C at byte 4"),
    ("shut\u200btle", "U+200B at byte 4"), ("word\u2060", "U+2060 at byte 4"),
    ("\ufeffshuttle", "U+FEFF at byte 0"), ("line\u2028", "U+2028 at byte 4"),
    ("\U0001f697\u2029", "U+2029 at byte 4"),
], ids=ascii)
def test_name_or_label_that_could_deceive_is_refused(text, said, stub):
    for field, fields in (("vehicle.display_name", {"display_name": text}),
                          ("vehicle.labels.a", {"labels": {"a": text}})):
        failure = failure_of(lambda fields=fields: create(stub, "hidden", **fields))
        assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
        assert failure.fields == [field]
        assert said in failure.message
        assert failure.message.isascii() and failure.message.isprintable()
    assert failure_of(lambda: get(stub, "vehicles/hidden")).reason == \
        "VEHICLE_NOT_FOUND"


@pytest.mark.parametrize("number, text", enumerate([
    "\u0645\u06cc\u200c\u062e\u0648\u0627\u0647\u0645", "\u0915\u094d\u200d\u0937",
    "\U0001f469\u200d\U0001f527\ufe0f", "soft\u00adhyphen \u00a0 \u3000"]), ids=ascii)
def test_name_and_label_of_any_script_are_kept(number, text, stub):
    made = create(stub, f"script-{number}", display_name=text, labels={"a": text})
    assert (made.display_name, made.labels["a"]) == (text, text)


def test_one_label_too_many_is_refused_and_the_others_stay(stub):
    labels = {f"key-{n}": "v" * 128 for n in range(128)}
    made = create(stub, "full", labels=labels, display_name="a" * 256)
    failure = failure_of(lambda: update(
        stub, made.name, ["labels.one-more"], labels={"one-more": "1"}))
    assert failure.fields == ["vehicle.labels"]
    assert "allowed are 128" in failure.message
    assert get(stub, made.name) == made
    assert update(stub, made.name, ["labels.key-0", "labels.one-more"],
                  labels={"one-more": "1"}).labels["one-more"] == "1"


@pytest.mark.parametrize("path", ["labels.", "label.a", "display_name.a",
                                  "uid", "name", "labels_a"])
def test_other_paths_are_refused(path, stub):
    made = create(stub, "paths")
    failure = failure_of(lambda: update(stub, made.name, [path]))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert failure.fields == ["update_mask.paths[0]"]


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_text_is_kept_as_it_is_or_refused_in_ascii(kind, stub):
    text = HOSTILE[kind]
    made = create(stub, "hostile")
    for paths, fields, kept in (
            (["display_name"], {"display_name": text},
             lambda v: v.display_name),
            (["labels.key"], {"labels": {"key": text}},
             lambda v: v.labels["key"])):
        try:
            after = update(stub, made.name, paths, **fields)
        except grpc.RpcError:
            failure = failure_of(lambda paths=paths, fields=fields: update(
                stub, made.name, paths, **fields))
            assert failure.reason == "INVALID_FIELD"
            assert failure.message.isascii() and failure.message.isprintable()
            # Only for what no text for people needs.
            assert len(text) > 128 or any(
                ord(c) < 0x20 or 0x7f <= ord(c) < 0xa0 or 0x2028 <= ord(c) <= 0x202e
                for c in text)
        else:
            assert kept(after) == text
            assert kept(get(stub, made.name)) == text


def test_pages_of_long_labels_stay_readable(tmp_path):
    # 200 vehicles with 24 kB of labels each.
    labels = {f"{'k' * 56}.{n:03}": "v" * 128 for n in range(128)}
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        for n in range(200):
            create(stub, f"v{n:03}", labels=labels)
        listed, token, pages = [], "", 0
        while True:
            page = stub.ListVehicles(api.ListVehiclesRequest(
                page_size=1000, page_token=token))
            assert page.ByteSize() < 2 << 20
            listed += [vehicle.name for vehicle in page.vehicles]
            pages += 1
            token = page.next_page_token
            if not token:
                break
        assert listed == [f"vehicles/v{n:03}" for n in range(200)]
        assert pages > 2


def test_name_and_labels_survive_kill_9_and_are_part_of_no_graph(tmp_path):
    store = tmp_path / "store"
    with Server(store) as server:
        stub = server.stub()
        create(stub, "a", display_name="A", labels=LABELS, settings={
            "coordinate_frame": api.COORDINATE_FRAME_GEODETIC})
        # The first pose writes the vehicle anew, with its origin.
        pose = straight(1)[0]
        pose.geodetic.latitude_degrees = 48.0
        append(stub, "vehicles/a", [pose])
        update(stub, "vehicles/a", ["labels.more"], labels={"more": "1"})
        before = get(stub, "vehicles/a")
        server.kill()
    with Server(store) as server:
        after = get(server.stub(), "vehicles/a")
        assert after == before
        assert dict(after.labels) == {**LABELS, "more": "1"}
        assert after.display_name == "A"
