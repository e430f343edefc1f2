"""Maps and files of vehicles, which the program makes for the package."""

import json

import pytest

import revisit
from conftest import straight


@pytest.fixture(scope="module")
def driven(client, boreas):
    client.create_vehicle("driven")
    with client.stream_poses("driven") as stream:
        stream.append(boreas[0])
    client.add_loop_closure("driven", 2068, 1072)
    return "driven"


def test_a_map_shows_itself_in_a_notebook(client, driven, tmp_path):
    made = client.map(driven, check_interval=500)
    shown = made._repr_html_()
    assert shown.startswith('<iframe srcdoc="&lt;!') and "sandbox" in shown
    assert "<script" in made.text and "<script" not in shown
    made.save(tmp_path / "map.html")
    assert (tmp_path / "map.html").read_text() == made.text
    drawing = client.map(driven, format="svg", check_interval=500, direction="either")
    assert drawing._repr_html_() == drawing.text and drawing.text.startswith("<svg")
    assert "opposite" in drawing.text.lower() or drawing.text != made.text
    assert "characters of svg" in repr(drawing)


def test_a_map_of_what_is_not_there_fails_as_calls_do(client, driven):
    with pytest.raises(revisit.NotFound) as caught:
        client.map("nobody")
    assert caught.value.reason == "VEHICLE_NOT_FOUND"
    assert caught.value.request_id
    with pytest.raises(ValueError, match="html, svg or geojson"):
        client.map(driven, format="png")
    with pytest.raises(ValueError, match="--direction"):
        client.map(driven, direction="up")


def test_files_of_optimisers_and_viewers_are_written(client, driven, tmp_path):
    client.export(driven, tmp_path / "drive.g2o")
    lines = (tmp_path / "drive.g2o").read_text().splitlines()
    assert sum(line.startswith("VERTEX_SE2 ") for line in lines) == 2076
    assert sum(line.startswith("EDGE_SE2 1072 2068 ") for line in lines) == 1
    client.export(driven, str(tmp_path / "drive.tum"))
    assert len((tmp_path / "drive.tum").read_text().splitlines()) == 2076
    client.export(driven, tmp_path / "nodes.txt", format="nodes-csv")
    assert (tmp_path / "nodes.txt").read_text().startswith("index,sequence,")
    with pytest.raises(ValueError, match="the ending of .*drive.doc is none of .g2o"):
        client.export(driven, tmp_path / "drive.doc")


def test_the_program_reaches_the_server_of_the_client(client, driven, tmp_path,
                                                      monkeypatch):
    """Whatever its own variables say."""
    monkeypatch.setenv("REVISIT_SERVER", "127.0.0.1:1")
    monkeypatch.setenv("REVISIT_TLS_CA", str(tmp_path / "none"))
    monkeypatch.setenv("REVISIT_TOKEN_FILE", str(tmp_path / "none"))
    client.export(driven, tmp_path / "drive.kitti")
    assert len((tmp_path / "drive.kitti").read_text().splitlines()) == 2076


def test_an_export_that_fails_says_why(client, driven, tmp_path):
    with pytest.raises(revisit.NotFound) as caught:
        client.export("nobody", tmp_path / "a.g2o")
    assert caught.value.reason == "VEHICLE_NOT_FOUND"
    with pytest.raises(revisit.RecordingError, match="has local positions"):
        client.export(driven, tmp_path / "a.geojson")
    assert list(tmp_path.iterdir()) == []


def test_geodetic_vehicles_are_written_as_geojson(client, tmp_path):
    client.create_vehicle("globe", coordinate_frame="geodetic")
    flat = straight(100)
    client.append_poses("globe", revisit.Poses.geodetic(
        43.7 + flat.position[:, 0] * 1e-5, [-79.4] * 100, flat.heading,
        flat.covariance, sequence=flat.sequence))
    client.export("globe", tmp_path / "globe.geojson")
    assert json.loads((tmp_path / "globe.geojson").read_text())[
        "type"] == "FeatureCollection"
