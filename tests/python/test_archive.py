"""Archives are Parquet files that anybody reads, hold what is stored to the bit, and
come to be only if they do."""

import datetime
import os

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

import revisit
import revisit.archive
from conftest import as_bytes, straight
from drive_client import Drive
from revisit import Poses, v1


def stored_drive(client, new_vehicle, count=300):
    """Orientations and forms of covariance in any mixture."""
    messages = Drive(7)[0:count]
    vehicle = new_vehicle()
    with client.stream_poses(vehicle) as stream:
        stream.append(Poses.from_messages(messages))
    return vehicle, messages


def test_every_kind_of_pose_comes_back(client, new_vehicle, tmp_path):
    vehicle, messages = stored_drive(client, new_vehicle)
    path = tmp_path / "drive.parquet"
    archived = revisit.archive.write(path, client, vehicle)
    assert archived == revisit.archive.Archived(path, 300, 1, 300)
    assert as_bytes(revisit.archive.read(path).to_messages()) == as_bytes(messages)
    assert os.listdir(tmp_path) == ["drive.parquet"]


def test_files_are_columns_that_others_read(client, new_vehicle, tmp_path, monkeypatch):
    monkeypatch.setattr(revisit.archive, "_ROWS", 7)
    poses = straight(20)
    vehicle = new_vehicle()
    client.append_poses(vehicle, poses)
    path = tmp_path / "drive.parquet"
    revisit.archive.write(path, client, vehicle)
    table = parquet.read_table(path)
    assert table.column("sequence").to_pylist() == list(range(1, 21))
    assert table.schema.field("stamp").type == pyarrow.timestamp("ns", tz="UTC")
    frame = table.to_pandas()
    np.testing.assert_array_equal(frame["x"], poses.position[:, 0])
    np.testing.assert_array_equal(np.stack(frame["covariance"]), poses.covariance)
    assert set(frame["covariance_form"]) == {"COVARIANCE_FORM_PLANAR_6"}
    assert table.schema.metadata[b"vehicle"] == f"vehicles/{vehicle}".encode()
    assert table.schema.metadata[b"vehicle_uid"] == (
        client.get_vehicle(vehicle).uid.encode())


def test_geodetic_poses_have_their_own_columns(client, new_vehicle, tmp_path):
    poses = Poses.geodetic(np.linspace(48.0, 48.001, 30), np.full(30, 11.5),
                           np.zeros(30), np.tile([1, 0, 0, 1, 0, 0.01], (30, 1)),
                           sequence=np.arange(1, 31))
    vehicle = new_vehicle(coordinate_frame=v1.COORDINATE_FRAME_GEODETIC)
    client.append_poses(vehicle, poses)
    path = tmp_path / "drive.parquet"
    revisit.archive.write(path, client, vehicle)
    assert {"latitude", "longitude", "height"} < set(parquet.read_schema(path).names)
    assert as_bytes(revisit.archive.read(path).to_messages()) == as_bytes(
        client.list_poses(vehicle))


def test_an_archive_ends_before_a_moment_or_at_a_sequence(client, new_vehicle,
                                                          tmp_path):
    stamps = np.datetime64("2026-01-01", "ns") + np.arange(20) * np.timedelta64(1, "s")
    poses = straight(20)
    vehicle = new_vehicle()
    client.append_poses(vehicle, Poses.local(
        poses.position[:, 0], poses.position[:, 1], poses.heading, poses.covariance,
        stamps=stamps, sequence=poses.sequence))

    def sequences(name, **bounds):
        archived = revisit.archive.write(tmp_path / name, client, vehicle, **bounds)
        kept = revisit.archive.read(tmp_path / name).sequence.tolist()
        assert archived.count == len(kept)
        assert kept == list(range(archived.first_sequence,
                                  archived.last_sequence + 1)) or not kept
        return kept

    assert sequences("a", before=stamps[12]) == list(range(1, 13))
    assert sequences("b", first_sequence=5, last_sequence=9) == list(range(5, 10))
    assert sequences("c", before=np.datetime64("2025-12-31")) == []
    moment = datetime.datetime(2026, 1, 1, 2, 0, 12, tzinfo=datetime.timezone(
        datetime.timedelta(hours=2)))
    assert sequences("d", before=moment) == list(range(1, 13))
    with pytest.raises(ValueError, match="no time zone"):
        sequences("e", before=moment.replace(tzinfo=None))
    assert not (tmp_path / "e").exists()


def test_what_changes_meanwhile_is_not_kept(client, new_vehicle, tmp_path, monkeypatch):
    vehicle, _ = stored_drive(client, new_vehicle, 50)
    compare = revisit.archive._compare
    revised = straight(1)

    def revise_first(*arguments):
        client.revise_poses(vehicle, revised)
        return compare(*arguments)

    monkeypatch.setattr(revisit.archive, "_compare", revise_first)
    # The generator of what is stored asks the server when it is compared.
    with pytest.raises(revisit.archive.Mismatch, match="sequence 1 "):
        revisit.archive.write(tmp_path / "drive.parquet", client, vehicle)
    assert os.listdir(tmp_path) == []


def test_a_file_that_is_there_stays(client, new_vehicle, tmp_path):
    vehicle, _ = stored_drive(client, new_vehicle, 5)
    path = tmp_path / "drive.parquet"
    path.write_text("mine")
    with pytest.raises(FileExistsError, match="is there already"):
        revisit.archive.write(path, client, vehicle)
    assert path.read_text() == "mine"


def test_starts_of_recordings_are_archived(client, new_vehicle, tmp_path):
    vehicle = new_vehicle()
    client.append_poses(vehicle, straight(20))
    second = straight(20).numbered(21).as_recording("datum:10m,1deg", label="b")
    client.append_poses(vehicle, second)
    client.append_poses(vehicle, straight(5).numbered(41).as_recording("after"))
    path = tmp_path / "two.parquet"
    revisit.archive.write(path, client, vehicle)
    back = revisit.archive.read(path)
    assert as_bytes(back.to_messages()) == as_bytes(client.list_poses(vehicle))
    assert [row for row, start in enumerate(back.recording_start)
            if start is not None] == [20, 40]
    # A file of an earlier version has no such column.
    table = parquet.read_table(path).drop_columns(["recording_start"])
    parquet.write_table(table, tmp_path / "older.parquet")
    older = revisit.archive.read(tmp_path / "older.parquet")
    assert older.recording_start.tolist() == [None] * 45
