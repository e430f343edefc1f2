"""Simulated drives over a small network of roads that is made by hand."""

import math
import pathlib
import random
import subprocess
import sys

import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import road_drives
from road_drives import Network, Pose, Road

# The roads are two blocks of 200 m side by side, and a dead end:
#
#   4---5---6
#   |   |   |
#   1---2---3---7
POSITIONS = {1: (0.0, 0.0), 2: (200.0, 0.0), 3: (400.0, 0.0),
             4: (0.0, 200.0), 5: (200.0, 200.0), 6: (400.0, 200.0),
             7: (900.0, 0.0)}
ROADS = [Road([1, 2, 3, 7], True, True), Road([4, 5, 6], True, True),
         Road([1, 4], True, True), Road([2, 5], True, True),
         Road([3, 6], True, True)]


def network(roads=ROADS):
    return Network(roads, POSITIONS)


def turns(poses):
    return [math.remainder(after.heading - before.heading, 2 * math.pi)
            for before, after in zip(poses, poses[1:])]


def test_a_vehicle_does_not_enter_what_it_would_have_to_turn_round_in():
    assert (3, 7) not in network().stretches
    assert (7, 3) not in network().stretches
    assert len(network().stretches) == 14


def test_oneway_streets_go_one_way():
    roads = [Road([1, 2, 5, 4, 1], True, False), *ROADS[:2]]
    assert (1, 4) not in network(roads).stretches
    assert (4, 1) in network(roads).stretches
    assert road_drives.directions({"oneway": "yes"}) == (True, False)
    assert road_drives.directions({"oneway": "-1"}) == (False, True)
    assert road_drives.directions({"junction": "roundabout"}) == (True, False)
    assert road_drives.directions({"highway": "motorway"}) == (True, False)
    assert road_drives.directions(
        {"highway": "motorway", "oneway": "no"}) == (True, True)
    assert road_drives.directions({"highway": "residential"}) == (True, True)


def test_a_network_without_a_way_back_is_refused():
    with pytest.raises(ValueError, match="drive for ever"):
        network([Road([1, 2, 3], True, True)])


def test_ways_are_the_shortest_that_need_no_turning_round():
    roads = network()
    assert roads.shortest_way((1, 2), (2, 3)) == [(2, 3)]
    # The way back along the same road leads round a block, either way.
    back = roads.shortest_way((1, 2), (2, 1))
    assert sum(map(roads.length, back)) == 1000.0
    for before, after in zip([(1, 2), *back], back):
        assert before[1] == after[0] and before[0] != after[1]
    assert roads.shortest_way((1, 2), (1, 2)) == []


def test_destinations_are_picked_by_length_near_the_start():
    roads = network()
    assert {start for start, _ in roads.near((1, 2), 250.0)} == {1, 2, 4}
    pick = roads.picker([(1, 2), (2, 3)])
    rng = random.Random(7)
    assert 400 < sum(pick(rng) == (1, 2) for _ in range(1000)) < 600


def test_turns_keep_the_least_radius_and_steps_their_length():
    poses = road_drives.drive(network(), 5000.0, seed=3)
    limit = road_drives.STEP / road_drives.LEAST_RADIUS
    assert max(map(abs, turns(poses))) <= limit + 1e-9
    assert max(map(abs, turns(poses))) > 0.5 * limit
    steps = [math.dist(after[:2], before[:2])
             for before, after in zip(poses, poses[1:])]
    # The chord of the tightest arc of 1 m is 1.2 mm shorter.
    assert min(steps) > 0.9988
    assert max(steps) <= 1.0 + 1e-12
    # A drive's heading is the direction of its path.
    for before, after in zip(poses, poses[1:]):
        direction = math.atan2(after.y - before.y, after.x - before.x)
        turn = math.remainder(after.heading - before.heading, 2 * math.pi)
        assert abs(math.remainder(direction - before.heading - turn / 2,
                                  2 * math.pi)) < 1e-9


def test_a_drive_is_as_long_as_asked_and_begins_at_the_origin():
    poses = road_drives.drive(network(), 1234.5, seed=1)
    assert len(poses) == 1236
    assert poses[0][:2] == (0.0, 0.0)


def test_a_vehicle_keeps_to_the_right_of_the_road():
    # The road is the x-axis, and draws of 0 leave no wander.
    class Still:
        @staticmethod
        def random():
            return 0.0

    middles = ((float(x), 0.0, 1.0, 0.0) for x in range(400))
    poses = road_drives.steer(road_drives.lane(middles, Still), 300)
    assert len(poses) > 100
    assert all(abs(pose.y + 1.75) < 1e-9 for pose in poses)


def test_the_same_seed_gives_the_same_drive():
    def drives(seed):
        truth = road_drives.drive(network(), 1000.0, seed)
        return truth, road_drives.dead_reckon(truth, seed)
    assert drives(5) == drives(5)
    assert drives(5)[0] != drives(6)[0]
    assert drives(5)[1] != drives(6)[1]


def test_an_estimate_without_noise_is_the_truth():
    truth = road_drives.drive(network(), 1000.0, seed=2)
    for true, estimate in zip(
            truth, road_drives.dead_reckon(truth, 1, noise_scale=0.0)):
        assert math.dist(true[:2], estimate[:2]) < 1e-6
        assert abs(math.remainder(true.heading - estimate.heading,
                                  2 * math.pi)) < 1e-9


def test_a_bias_of_the_gyro_turns_the_estimate_with_time():
    straight = [Pose(float(x), 0.0, 0.0) for x in range(101)]
    bent = road_drives.dead_reckon(straight, 1, 0.0, gyro_bias=0.02)
    # A metre takes 0.1 s, so 100 m turn by 0.2 rad: an arc of 500 m of radius.
    assert bent[-1].heading == pytest.approx(0.2)
    assert bent[-1].x == pytest.approx(500.0 * math.sin(0.2), abs=0.01)
    assert bent[-1].y == pytest.approx(500.0 * (1 - math.cos(0.2)), abs=0.01)


def test_noise_grows_with_the_root_of_the_distance():
    straight = [Pose(float(x), 0.0, 0.0) for x in range(101)]
    ends = [road_drives.dead_reckon(straight, seed)[-1]
            for seed in range(2000)]
    assert math.sqrt(sum((end.x - 100.0) ** 2 for end in ends) / 2000) \
        == pytest.approx(math.sqrt(1.0 + 0.01), rel=0.1)
    assert math.sqrt(sum(end.heading ** 2 for end in ends) / 2000) \
        == pytest.approx(math.hypot(math.radians(1.0), 0.01), rel=0.1)


def test_the_file_is_a_drive_file(tmp_path):
    road_drives.write_drive(
        tmp_path / "d.csv", [Pose(0.0, 0.0, 0.5), Pose(1.0, 2.0, 0.25)],
        [Pose(0.1, 0.0, 0.5), Pose(1.1, 2.0, 0.125)])
    assert (tmp_path / "d.csv").read_text().splitlines() == [
        "frame,t_s,gt_x,gt_y,gt_yaw,est_x,est_y,est_yaw",
        "0,0.000,0.000,0.000,0.500000,0.100,0.000,0.500000",
        "1,0.100,1.000,2.000,0.250000,1.100,2.000,0.125000"]


def test_the_program_names_source_and_licence():
    result = subprocess.run(
        [sys.executable, road_drives.__file__, "--help"], text=True,
        stdout=subprocess.PIPE, check=True)
    assert "OpenStreetMap contributors, ODbL 1.0" in result.stdout
