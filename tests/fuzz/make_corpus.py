#!/usr/bin/env python3
"""Writes the seeds of the fuzz targets into tests/fuzz/corpus. Run with
build/python/bin/python; what fuzzing found is kept beside them."""

import gzip
import math
import pathlib
import sys

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "integration"))

from google.protobuf import field_mask_pb2, timestamp_pb2  # noqa: E402

from stubs import api  # noqa: E402
from wire import columns_of, laps, pose, straight  # noqa: E402


def write(target, name, data):
    folder = HERE / "corpus" / target
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(data)


def quaternion_pose(n):
    return api.Pose(
        sequence=n, stamp=timestamp_pb2.Timestamp(seconds=1600000000 + n),
        local=api.LocalPosition(x_meters=n, y_meters=0.5 * n, z_meters=0.1),
        quaternion=api.Quaternion(w=math.cos(0.2), z=math.sin(0.2)),
        covariance=api.Covariance(
            form=api.COVARIANCE_FORM_ROS_36,
            values=[float(i % 7 == 0) * 0.01 for i in range(36)]))


def spatial_pose(n):
    one = pose(n, x=float(n))
    one.covariance.CopyFrom(api.Covariance(
        form=api.COVARIANCE_FORM_SPATIAL_10,
        values=[1, 0, 0, 0, 1, 0, 0, 1, 0, 0.01]))
    return one


def geodetic_pose(n):
    one = pose(n)
    one.geodetic.CopyFrom(api.GeodeticPosition(
        latitude_degrees=43.8 + n * 1e-5, longitude_degrees=-79.5,
        height_meters=150))
    return one


def filter_pose(n):
    one = pose(n, x=float(n))
    one.error_transition.extend([1, 0, 0, 0, 1, 0, 0, 0, 1])
    return one


POSES = {
    # By kind of vehicle: see vehicles.cc.
    "planar": (0, straight(20)),
    "laps": (0, laps(160, radius=10.0)),
    "quaternions": (0, [quaternion_pose(n) for n in range(1, 6)]),
    "spatial": (1, [spatial_pose(n) for n in range(1, 30)]),
    "geodetic": (2, [geodetic_pose(n) for n in range(1, 30)]),
    "filter": (4, [filter_pose(n) for n in range(1, 40)]),
    "jumps": (0, [pose(n, x=1000.0 * (n % 3)) for n in range(1, 10)]),
    "extreme": (0, [pose(1, x=1e8, covariance=(1e18, 0, 0, 1e18, 0, 1.0)),
                    pose(2, x=1e8, y=-0.0, heading=1e6),
                    pose(3, x=math.nan), pose(2**63, y=math.inf)]),
}

SETTINGS = api.VehicleSettings(
    state_space=api.STATE_SPACE_SPATIAL, node_spacing_meters=0.5,
    sequence_length_meters=40, check_interval_meters=10,
    gate_probability=0.9, max_candidates=7, apply_inflation=True,
    coordinate_frame=api.COORDINATE_FRAME_GEODETIC,
    geodetic_origin=api.GeodeticPosition(latitude_degrees=1,
                                         longitude_degrees=2))
OPTIONS = api.CandidateOptions(
    max_candidates=3, gate_probability=0.5, include_aligned_path=True,
    alignment=api.ALIGNMENT_COMPOSITE, sequence_length_meters=10,
    use_belief=False)
NAME = "vehicles/shuttle-1"
LABELLED = api.Vehicle(name=NAME, display_name="Truck 7",
                       labels={"session.a": "1-2068"})
MEASUREMENT = api.LoopClosureMeasurement(
    x_meters=1.5, y_meters=-2, heading_radians=0.1,
    covariance=api.Covariance(form=api.COVARIANCE_FORM_PLANAR_6,
                              values=[0.04, 0, 0, 0.04, 0, 0.0004]))


def requests():
    def put(name, number, message, kind=0):
        write("requests", name,
              bytes([number, kind]) + message.SerializeToString())

    put("create", 0, api.CreateVehicleRequest(
        vehicle_id="shuttle-1", vehicle=api.Vehicle(settings=SETTINGS)))
    put("create_plain", 0, api.CreateVehicleRequest(vehicle_id="a"))
    put("update", 1, api.UpdateVehicleRequest(
        vehicle=api.Vehicle(name=NAME, settings=SETTINGS),
        update_mask=field_mask_pb2.FieldMask(
            paths=["settings.max_candidates", "settings"])))
    put("create_labels", 0, api.CreateVehicleRequest(
        vehicle_id="a", vehicle=LABELLED))
    put("update_labels", 1, api.UpdateVehicleRequest(
        vehicle=LABELLED, update_mask=field_mask_pb2.FieldMask(
            paths=["labels.session.a", "display_name"])))
    for name, (kind, poses) in POSES.items():
        put(f"append_{name}", 2, api.AppendPosesRequest(
            vehicle=NAME, poses=poses), kind)
        if name != "extreme":
            put(f"append_columns_{name}", 2, api.AppendPosesRequest(
                vehicle=NAME, columns=columns_of(poses)), kind)
    kind, poses = POSES["planar"]
    put("stream_columns", 3, api.StreamPosesRequest(
        batch=api.PoseBatch(columns=columns_of(poses))), kind)
    put("stream_batch", 3, api.StreamPosesRequest(
        batch=api.PoseBatch(poses=poses)), kind)
    put("stream_open", 3, api.StreamPosesRequest(open=api.StreamPosesOpen(
        vehicle=NAME, acked_sequence=9, send_candidates=True,
        candidate_options=OPTIONS)))
    put("find", 4, api.FindCandidatesRequest(
        vehicle=NAME, sequence=5, options=OPTIONS))
    put("closure", 5, api.AddLoopClosureRequest(
        parent=NAME, loop_closure_id="x", loop_closure=api.LoopClosure(
            query_sequence=9, matched_sequence=2)))
    put("closure_measured", 5, api.AddLoopClosureRequest(
        parent=NAME, loop_closure=api.LoopClosure(
            query_sequence=9, matched_sequence=2, measurement=MEASUREMENT,
            note="icp\n412", score=0.5)))
    put("reject", 6, api.RejectCandidateRequest(
        parent=NAME, rejected_candidate=api.RejectedCandidate(
            query_sequence=9, matched_sequence=2)))
    put("reject_noted", 6, api.RejectCandidateRequest(
        parent=NAME, rejected_candidate=api.RejectedCandidate(
            query_sequence=9, matched_sequence=2, note="a bridge\n\tabove")))
    put("revise", 7, api.RevisePosesRequest(
        vehicle=NAME, expected_revision=3, poses=poses))
    put("revise_filter", 7, api.RevisePosesRequest(
        vehicle=NAME, poses=POSES["filter"][1][:5]), 4)
    put("list", 8, api.ListPosesRequest(
        parent=NAME, page_size=3, page_token="MAAA", first_sequence=4,
        read_mask=field_mask_pb2.FieldMask(
            paths=["local.x_meters", "sequence"])))
    put("delete", 9, api.DeleteLoopClosureRequest(
        name=f"{NAME}/loopClosures/2-1"))


def stored_columns(poses):
    """A stored batch: columns are its field 3, behind their size as a varint."""
    columns = columns_of(poses).SerializeToString()
    size = len(columns)
    assert size < 2**14
    return (bytes([0x1a]) + (bytes([size]) if size < 128
                             else bytes([size & 127 | 128, size >> 7])) + columns)


def records():
    # Field 1 of PosePairContent.
    measurement = MEASUREMENT.SerializeToString()
    write("records", "closure",
          bytes([3, 0, 0x0a, len(measurement)]) + measurement)
    for kind in (0, 5):
        write("records", f"state_{kind}", bytes([4, kind]))
        write("records", f"state_changed_{kind}",
              bytes([4, kind, 0, 2, 40, 1, 0, 0, 90, 128]))
    write("records", "vehicle", bytes([0, 0]) + api.Vehicle(
        settings=SETTINGS, state=api.VEHICLE_STATE_DATA_LOSS,
        create_time=timestamp_pb2.Timestamp(seconds=1)).SerializeToString())
    # Field 2 of PoseBatch: poses 5 to 104 were dropped, over 321.5 m.
    write("records", "dropped", bytes([1, 0]) +
          bytes.fromhex("120d08051068190000000000187440"))
    for name, (kind, poses) in POSES.items():
        for record in (1, 2):
            write("records", f"batch_{name}_{record}", bytes([record, kind]) +
                  api.PoseBatch(poses=poses).SerializeToString())
            if name != "extreme":
                write("records", f"columns_{name}_{record}",
                      bytes([record, kind]) + stored_columns(poses))


def names():
    for i, text in enumerate([
            NAME, "a", "a" * 63, "vehicles/", "vehicles/../x",
            f"{NAME}/loopClosures/2-1", f"{NAME}/rejectedCandidates/x",
            "MRsVbgS8", "\x1b[31mred\x1b[0m\n{\"a\":1}", "vehicles/\0",
            "vehicles/%2e%2e", "\u202evehicles/\u0430", "\\\"\\u0000"]):
        write("names", f"seed_{i}", text.encode())
    write("names", "not_utf8", b"\xff\xfe\xc0\x80\xed\xa0\x80\xf4\x90\x80\x80")


def settings():
    write("settings", "file", b"\0\0# comment\nlisten = \"127.0.0.1:0\"\n"
          b"max-batch-poses = 7\nlog-format = json\nstore = \"a\\\"b\\n\"\n")
    write("settings", "variable", b"REVISIT_MAX_SEARCHES=4\0\0")
    write("settings", "flag", b"\0--keepalive-seconds=30\0")
    write("settings", "bad", b"REVISIT_X\0--max-calls=1e3\0a = b\na\n= \"\n")


def sentence(body):
    checksum = 0
    for one in body.encode():
        checksum ^= one
    return f"${body}*{checksum:02X}\r\n"


def files():
    # The format (client/formats/reader.h; behind the last of them, the truth of a
    # drive) and how it is read.
    drive, tum, kitti, g2o, rtklib, gpx, nmea, ros, reference = range(1, 10)
    by_content = 0

    def put(name, kind, text, how=0):
        data = text if isinstance(text, bytes) else text.encode()
        write("files", name, bytes([kind, how]) + data)

    put("drive", drive, "frame,t_s,est_x,est_y,est_yaw,gt_x,gt_y,gt_yaw,pxx,"
        "pxy,pxt,pyy,pyt,ptt\n0,0.5,1,2,0.1,1,2,0.1,1,0,0,1,0,1\n"
        "1,1.5,2,2,0.1,2,2,0.1,1,0,0,1,0,1e-3\n")
    put("drive_short", drive, "t_s,est_x,est_y,est_yaw\r\n1,2,3,nan\r\n")
    put("drive_twice", drive, "t_s,est_x,est_y,est_yaw,t_s\n1,2,3,4,5\n")
    put("drive_transitions", drive, "\ufefft_s;est_x;est_y;est_yaw;fxx;fxy;fxt;"
        "fyx;fyy;fyt;ftx;fty;ftt\n2021-08-05T13:34:46.5+02:00;1;2;0;1;0;0;0;1;"
        "0;0;0;1\n1628184886518266789;1;2;0;1;0;0;0;1;0;0;0;1\n", how=34)
    put("positions", drive, "t_s,lat,lon,height\n" + "".join(
        f"{i},35.2,{136.9 + i * 1e-4},40\n" for i in range(20)))
    straight_drive = "t_s,est_x,est_y,est_yaw\n" + "".join(
        f"{i},{i * 2},0,{90 * (i % 2)}\n" for i in range(120))
    put("suspicious", drive, straight_drive)
    tum_text = "# t x y z q\n1.5 1 2 3 0 0 0 1\n2 1 2 3 0 0 .6 .8\n"
    put("tum", tum, tum_text)
    put("tum_camera", by_content, tum_text.split("\n", 1)[1], how=1)
    put("kitti", kitti, "1 0 0 0 0 1 0 0 0 0 1 0\n"
        "0 -1 0 1.5e+00 1 0 0 2.5e+00 0 0 1 0.5\n", how=49)
    put("g2o", g2o, "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 2 0 1.57\nFIX 0\n"
        "EDGE_SE2 0 1 2 0 1.57 4 0 0 25 0 100\n")
    put("g2o_spatial", g2o, "VERTEX_SE3:QUAT 5 0 0 0 0 0 0 1\n"
        "VERTEX_SE3:QUAT 7 1 0 0.5 0 0 0 1\nEDGE_SE3:QUAT 5 7 1 0 0.5 0 0 0 1 "
        "4 0 0 0 0 0 5 0 0 0 0 10 0 0 0 100 0 0 100 0 400\n")
    header = ("%  GPST                  latitude(deg) longitude(deg)  height(m)"
              "   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m)"
              " age(s)  ratio    vn(m/s)    ve(m/s)    vu(m/s)      sdvn     "
              "sdve     sdvu    sdvne    sdveu    sdvun\n")
    row = ("2019/05/11 02:19:0{}.000   35.17{}  136.96   50.1   2   9   1.0"
           "   1.0   2.0   0.1   0.0   0.0   0.0    0.0   {}    2.0    0.0"
           "   0.1   0.1   0.1   0.0   0.0   0.0\n")
    put("rtklib", rtklib, header + row.format(0, 1, 1.0)
        + row.format(1, 2, -3.5) + row.format(2, 3, 0.0))
    put("rtklib_weeks", rtklib, "%  GPST latitude(deg) longitude(deg) height(m)"
        "\n2270 194670.200 35.1 136.9 39.6\n2270 194671.2 35.1001 136.9 39.6\n"
        "2270 194672.2 35.1002 136.9 39.6\n")
    put("gpx", gpx, '<?xml version="1.0"?><gpx><trk><trkseg>'
        '<trkpt lat="48.1" lon="11.5"><ele>545.4</ele>'
        "<time>2021-08-05T13:34:46Z</time></trkpt>"
        '<trkpt lat="48.1002" lon="11.5"/></trkseg></trk></gpx>')
    put("gpx_entity", gpx, '<!DOCTYPE gpx [<!ENTITY a "b">]><gpx>&a;</gpx>')
    put("nmea", nmea, sentence("GPGGA,235959.50,4807.038,N,01131.000,E,1,08,"
                               "0.9,545.4,M,46.9,M,,")
        + sentence("GPRMC,235959.50,A,4807.038,N,01131.000,E,010.0,090.0,"
                   "230394,003.1,W")
        + sentence("GPRMC,000000.50,A,4807.038,N,01131.100,E,010.0,090.0,"
                   "240394,003.1,W"))
    values = ",".join(str(i % 7) for i in range(78))
    put("ros", ros, f"1628184886,518266789,odom,base,1,2,3,0,0,0.6,0.8,{values}"
        "\n")
    names = (["%time", "field.header.stamp"]
             + [f"field.pose.pose.position.{axis}" for axis in "xyz"]
             + [f"field.pose.pose.orientation.{axis}" for axis in "xyzw"]
             + [f"field.pose.covariance{i}" for i in range(36)])
    put("rostopic", by_content, ",".join(names) + "\n5,0,1,2,3,0,0,0,1,"
        + ",".join("1" for _ in range(36)) + "\n")
    put("gzip", by_content, gzip.compress(straight_drive.encode(), mtime=0), 32)
    put("zstd", by_content, bytes.fromhex("28b52ffd") + b"\x04\x00")
    put("reference", reference, "GPS TOW (s),GPS Week,Latitude (deg),"
        "Longitude (deg),Ellipsoid Height (m),Heading (deg)\n"
        "529158.0,2051,35.17,136.96,50.0,359.9\n")


requests()
records()
names()
settings()
files()
