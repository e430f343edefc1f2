"""Recordings of ROS become poses: positions, orientations, covariances and stamps as
they were recorded."""

import math

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import revisit
import revisit.rosbag
from revisit import v1

ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROS1 = get_typestore(Stores.ROS1_NOETIC)
COUNT = 120
ODOMETRY, POSE, FIX = revisit.rosbag.SUPPORTED
#: Half a minute past this second, so that whole seconds and parts both count.
BEGIN = 1_628_170_440_500_000_000


class Messages:
    """Messages of one typestore."""

    def __init__(self, store):
        self.store = store

    def make(self, kind, *fields):
        return self.store.types[kind](*fields)

    def header(self, nanoseconds):
        stamp = self.make("builtin_interfaces/msg/Time",
                          nanoseconds // 10**9, nanoseconds % 10**9)
        sequence = [0] if self.store is ROS1 else []
        return self.make("std_msgs/msg/Header", *sequence, stamp, "odom")

    def pose(self, x, y, yaw, covariance):
        return self.make(
            "geometry_msgs/msg/PoseWithCovariance", self.make(
                "geometry_msgs/msg/Pose",
                self.make("geometry_msgs/msg/Point", x, y, 0.25),
                self.make("geometry_msgs/msg/Quaternion", 0.0, 0.0,
                          math.sin(yaw / 2), math.cos(yaw / 2))), covariance)

    def odometry(self, nanoseconds, x, y, yaw, covariance):
        zero = self.make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        return self.make(
            ODOMETRY, self.header(nanoseconds), "base_link",
            self.pose(x, y, yaw, covariance),
            self.make("geometry_msgs/msg/TwistWithCovariance",
                      self.make("geometry_msgs/msg/Twist", zero, zero), np.zeros(36)))

    def stamped(self, nanoseconds, x, y, yaw, covariance):
        return self.make(POSE, self.header(nanoseconds),
                         self.pose(x, y, yaw, covariance))

    def fix(self, nanoseconds, latitude, longitude, covariance, status=0, kind=2):
        return self.make(
            FIX, self.header(nanoseconds),
            self.make("sensor_msgs/msg/NavSatStatus", status, 1), latitude,
            longitude, 180.0, covariance, kind)


def stamp_of(index):
    return BEGIN + index * 100_000_001


def covariance_of(index):
    made = np.diag([0.01, 0.02, 0.03, 1e-6, 1e-6, 1e-4]) * (index + 1)
    made[0, 1] = made[1, 0] = 0.001 * (index + 1)
    made[0, 5] = made[5, 0] = 1e-5
    return made.ravel()


def circle(index):
    angle = index / 20
    return 20 * math.cos(angle), 20 * math.sin(angle), angle + math.pi / 2


def write(path, topics, store=ROS2, plugin=StoragePlugin.SQLITE3):
    """`topics`: (name, type, messages) each."""
    writer = (Writer1(path) if store is ROS1
              else Writer(path, version=9, storage_plugin=plugin))
    with writer:
        for name, kind, messages in topics:
            connection = writer.add_connection(name, kind, typestore=store)
            for index, message in enumerate(messages):
                data = (store.serialize_ros1(message, kind) if store is ROS1
                        else store.serialize_cdr(message, kind))
                writer.write(connection, stamp_of(index) + 5_000_000, data)
    return path


def odometry_bag(path, store=ROS2, plugin=StoragePlugin.SQLITE3, make="odometry",
                 covariance=covariance_of):
    messages = Messages(store)
    return write(path, [("/odom", ODOMETRY if make == "odometry" else POSE, [
        getattr(messages, make)(stamp_of(index), *circle(index), covariance(index))
        for index in range(COUNT)])], store, plugin)


@pytest.mark.parametrize("make", ["odometry", "stamped"])
@pytest.mark.parametrize("store, plugin", [
    (ROS2, StoragePlugin.SQLITE3), (ROS2, StoragePlugin.MCAP), (ROS1, None)],
    ids=["sqlite3", "mcap", "ros1"])
def test_poses_of_a_bag_are_stored_as_recorded(
        client, new_vehicle, tmp_path, store, plugin, make):
    # The suffix says that it is one of ROS 1.
    path = odometry_bag(tmp_path / ("drive.bag" if store is ROS1 else "drive"), store,
                        plugin, make)
    poses = revisit.rosbag.read_poses(path)
    vehicle = new_vehicle()
    with client.stream_poses(vehicle) as stream:
        stream.append(poses)
    back = client.poses(vehicle)
    assert back.sequence.tolist() == list(range(1, COUNT + 1))
    for index in range(COUNT):
        x, y, yaw = circle(index)
        assert back.position[index].tolist() == [x, y, 0.25]
        assert back.quaternion[index].tolist() == [
            0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)]
        assert back.covariance[index].tolist() == covariance_of(index).tolist()
        assert back.stamp[index].astype(int) == stamp_of(index)
    assert set(back.covariance_form) == {v1.COVARIANCE_FORM_ROS_36}


def test_a_single_mcap_file_is_a_bag(tmp_path):
    path = odometry_bag(tmp_path / "drive", plugin=StoragePlugin.MCAP)
    [file] = path.glob("*.mcap")
    assert len(revisit.rosbag.read_poses(file)) == COUNT


def test_a_bag_goes_on_where_the_vehicle_stands(client, new_vehicle, tmp_path):
    path = odometry_bag(tmp_path / "drive")
    vehicle = new_vehicle()
    client.append_poses(vehicle, revisit.rosbag.read_poses(path)[:47])
    with client.stream_poses(vehicle) as stream:
        durable = stream.wait_until_opened()
        sizes = []
        for batch in revisit.rosbag.iter_poses(path, after=durable, batch=30):
            sizes.append(len(batch))
            stream.append(batch)
    assert sizes == [30, 30, 13]
    stored, read = client.poses(vehicle), revisit.rosbag.read_poses(path)
    assert stored.position.tobytes() == read.position.tobytes()
    assert stored.sequence.tolist() == read.sequence.tolist()


def fixes(count=60, kind=2, status=0, spacing=2.0):
    """A drive to the north-east, then a stop; each fix 0.3 m east, 0.4 m north."""
    messages = Messages(ROS2)
    covariance = np.diag([0.09, 0.16, 0.5]).ravel()
    made = []
    for index in range(count):
        meters = min(index, count - 10) * spacing
        latitude = 43.0 + meters * math.sin(math.pi / 4) / 111_108.6
        longitude = -79.0 + meters * math.cos(math.pi / 4) / 81_541.0
        made.append(messages.fix(stamp_of(index), latitude, longitude, covariance,
                                 status, kind))
    return made


def test_fixes_get_the_course_as_heading(client, new_vehicle, tmp_path):
    path = write(tmp_path / "drive", [("/fix", FIX, fixes())])
    poses = revisit.rosbag.read_poses(path, course_step=5.0)
    # Every third fix has moved by more than 5 m; the last ten stand.
    assert len(poses) == 16
    assert np.allclose(poses.heading, math.pi / 4, atol=2e-3)
    assert np.all(poses.is_geodetic)
    assert set(poses.position[:, 2]) == {180.0}
    # Both ends across a chord of 6 m: 2 (0.09 + 0.16) / 2 / 36.
    assert np.allclose(poses.covariance[:, -1], 0.25 / 36, rtol=1e-2)
    assert poses.covariance[0, :-1].tolist() == [
        0.09, 0.0, 0.0, 0.0, 0.16, 0.0, 0.0, 0.5, 0.0]
    for state_space in (v1.STATE_SPACE_PLANAR, v1.STATE_SPACE_SPATIAL):
        vehicle = new_vehicle(
            state_space=state_space,
            coordinate_frame=v1.COORDINATE_FRAME_GEODETIC,
            correlation_model=v1.CORRELATION_MODEL_INDEPENDENT)
        with client.stream_poses(vehicle) as stream:
            stream.append(poses)
        graph = client.export_pose_graph(vehicle)
        # 45 chords of 2 m, in the frame that the server makes of them.
        assert graph.nodes["travelled"][-1] == pytest.approx(90, abs=2.1)


def test_fixes_that_are_none_are_left_out(tmp_path):
    some = fixes(20, spacing=6.0)
    some[5:7] = fixes(20, status=-1, spacing=6.0)[5:7]
    some[9].latitude = float("nan")
    path = write(tmp_path / "drive", [("/fix", FIX, some)])
    poses = revisit.rosbag.read_poses(path)
    # Eleven fixes are on the move: three are none, and one only begins the course.
    assert len(poses) == 11 - 3 - 1
    assert np.allclose(poses.heading, math.pi / 4, atol=2e-3)


def test_messages_without_covariance_need_one_that_stands_in(tmp_path):
    bag = odometry_bag(tmp_path / "odometry", covariance=lambda index: np.zeros(36))
    with pytest.raises(ValueError, match="message 0 of /odom states no covariance"):
        revisit.rosbag.read_poses(bag)
    stand_in = np.eye(6) * 0.5
    poses = revisit.rosbag.read_poses(bag, covariance=stand_in)
    assert poses.covariance.tolist() == [stand_in.ravel().tolist()] * COUNT
    with pytest.raises(ValueError, match="6x6"):
        revisit.rosbag.read_poses(bag, covariance=np.eye(3))
    bag = write(tmp_path / "fixes", [("/fix", FIX, fixes(kind=0))])
    with pytest.raises(ValueError, match="3x3"):
        revisit.rosbag.read_poses(bag)
    assert len(revisit.rosbag.read_poses(bag, covariance=np.eye(3))) == 16


def test_of_several_topics_one_is_to_be_named(tmp_path):
    messages = Messages(ROS2)
    one = [messages.odometry(stamp_of(0), 0.0, 0.0, 0.0, covariance_of(0))]
    path = write(tmp_path / "drive", [
        ("/a", ODOMETRY, one), ("/b", FIX, fixes()),
        ("/text", "std_msgs/msg/String",
         [messages.make("std_msgs/msg/String", "hello")])])
    assert revisit.rosbag.topics(path) == {"/a": ODOMETRY, "/b": FIX}
    with pytest.raises(ValueError, match=r"2 topics .*/a \(nav_msgs.*name one"):
        revisit.rosbag.read_poses(path)
    assert len(revisit.rosbag.read_poses(path, "/a")) == 1
    assert len(revisit.rosbag.read_poses(path, "/b")) == 16
    for topic in ("/text", "/nothing"):
        with pytest.raises(ValueError, match=f"no topic {topic} of a type"):
            revisit.rosbag.read_poses(path, topic)


def test_what_is_no_bag_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError):
        revisit.rosbag.read_poses(tmp_path / "nothing")
    (tmp_path / "text.mcap").write_text("this is no recording")
    with pytest.raises(ValueError, match="cannot be read as a bag"):
        revisit.rosbag.read_poses(tmp_path / "text.mcap")


def two_runs(index):
    """Twice the same way from the origin, 60 poses long."""
    return 2.0 * (index % 60), 0.0, 0.0


def restarted_bag(path, covariance):
    messages = Messages(ROS2)
    return write(path, [("/odom", ODOMETRY, [
        messages.odometry(stamp_of(index), *two_runs(index), covariance(index))
        for index in range(COUNT)])])


def starts(poses):
    return [int(sequence) for sequence, start in zip(poses.sequence,
                                                     poses.recording_start)
            if start is not None]


@pytest.mark.parametrize("covariance, expected", [
    (lambda index: covariance_of(index % 60), [61]),
    # Drivers that write one covariance into each message.
    (lambda index: covariance_of(0), [61]),
    # The estimator says itself that it has become less certain.
    (covariance_of, []),
], ids=["anew", "constant", "growing"])
def test_odometry_that_began_anew_begins_a_recording(
        client, new_vehicle, tmp_path, caplog, covariance, expected):
    bag = restarted_bag(tmp_path / "bag", covariance)
    poses = revisit.rosbag.read_poses(bag)
    assert starts(poses) == expected
    said = [record.getMessage() for record in caplog.records
            if "another recording begins" in record.getMessage()]
    assert len(said) == len(expected)
    assert all("pose 61" in text for text in said)
    assert starts(revisit.rosbag.read_poses(bag, recordings=False)) == []
    # In batches, and where a stream goes on in the middle, the same.
    for after in (0, 10, 60):
        batches = list(revisit.rosbag.iter_poses(bag, after=after, batch=7))
        assert sum((starts(batch) for batch in batches), []) == [
            first for first in expected if first > after]
    vehicle = new_vehicle()
    with client.stream_poses(vehicle) as stream:
        for batch in revisit.rosbag.iter_poses(bag):
            stream.append(batch)
    assert len(list(client.list_recordings(vehicle))) == 1 + len(expected)
