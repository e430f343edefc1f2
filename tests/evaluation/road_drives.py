#!/usr/bin/env python3
"""Simulated drives over the roads of an OpenStreetMap extract.

    road_drives.py EXTRACT.osm.pbf --out DRIVE.csv [--length-km KM] [--seed N]
                   [--radius-km KM] [--noise-scale FACTOR]
                   [--gyro-bias-deg-s DEG_PER_S] [--vehicles N]

The result is a drive file with truth for `revisit evaluate`: metres, radians
and seconds, x to the east, y to the north, the first true position at 0, 0.
With `--vehicles`, it is as many files, DRIVE-1.csv and so on, of the seeds from N
on, whose true positions are in one frame: that of the map.

Roads: motorway to residential with their links, without service roads and what
is private; oneway streets go one way. A vehicle starts where roads are dense,
picks random destinations near its start (`--radius-km`), and takes the shortest
way to each, never turning round on the spot, so that roads are driven again as
they are by real vehicles: the main ones often, in part, and from other sides. It
steers for a lane at the right of the road's middle, with a slow wander, and cannot turn
more tightly than 6 m of radius. It does 10 m/s, one sample each metre.

The estimate is dead reckoning with the noise of the protocol: 0.1 m along,
0.05 m across and 0.1 degree per square root of a metre. `--noise-scale` makes
each of these larger, and `--gyro-bias-deg-s` adds a constant error to the
heading's rate. (`revisit evaluate --simulate SEEDS` draws the estimate anew.)

The map is flat: a road that lies on top of another, on a bridge or in a tunnel,
counts as the same place where their directions agree.

Extracts are (c) OpenStreetMap contributors and come under the Open Database
License (ODbL) 1.0, https://www.openstreetmap.org/copyright; drives made from
one are derived from it. Neither is shipped with this program.

Needs Python 3.8 or newer and, to read an extract, the package `osmium`.
"""

import argparse
import bisect
import collections
import heapq
import itertools
import math
import pathlib
import random
import sys

HEADER = "frame,t_s,gt_x,gt_y,gt_yaw,est_x,est_y,est_yaw"

ROADS = frozenset(
    kind + link for link in ("", "_link")
    for kind in ("motorway", "trunk", "primary", "secondary", "tertiary")
) | {"unclassified", "residential"}
EARTH_RADIUS = 6371008.8

STEP = 1.0  # metres between samples
SPEED = 10.0  # metres per second
LEAST_RADIUS = 6.0  # metres; a car's turning circle is about 11 m across
LANE_OFFSET = 1.75  # metres to the right; half a lane of 3.5 m
WANDER = 0.3  # standard deviation about the lane's middle, metres
WANDER_LENGTH = 100.0  # metres after which it is forgotten
# The vehicle steers for the point of its lane this far ahead, metres: nearer
# ones make it weave, farther ones cut corners across the pavement.
LOOK_AHEAD = 8.0

# Standard deviations per square root of a metre and at the start, metres and
# radians, as in client/trajectory/dead_reckoning.h.
ALONG, ACROSS, HEADING = 0.1, 0.05, math.radians(0.1)
START_POSITION, START_HEADING = 0.1, 0.01

# The start is the one of so many draws that has the most road around it: a
# single draw would often fall on the countryside that an extract has too.
START_DRAWS = 8

Road = collections.namedtuple("Road", "nodes, forward, backward")
Pose = collections.namedtuple("Pose", "x, y, heading")


def directions(tags):
    """Whether a road may be driven (as it is drawn, the other way round)."""
    oneway = tags.get("oneway", "")
    if oneway in ("-1", "reverse"):
        return False, True
    implied = (tags.get("junction") in ("roundabout", "circular")
               or tags.get("highway") in ("motorway", "motorway_link"))
    if oneway in ("yes", "true", "1") or (implied and oneway != "no"):
        return True, False
    return True, True


def read_roads(path):
    """Roads of an extract, and each node's (longitude, latitude), degrees."""
    # It is imported here so that what needs no extract does without it.
    import osmium
    roads, places = [], {}
    ways = osmium.FileProcessor(str(path)).with_locations()
    for way in ways:
        if not way.is_way() or way.tags.get("highway") not in ROADS:
            continue
        if way.tags.get("access") in ("no", "private"):
            continue
        # An extract's border cuts roads: what lies outside has no location.
        nodes = [node for node in way.nodes if node.location.valid()]
        for node in nodes:
            places[node.ref] = (node.location.lon, node.location.lat)
        tags = {key: way.tags.get(key)
                for key in ("highway", "oneway", "junction")}
        tags = {key: value for key, value in tags.items() if value is not None}
        roads.append(Road([node.ref for node in nodes], *directions(tags)))
    return roads, places


def project(places):
    """Metres east and north of the mean: {node: (x, y)}."""
    latitude = sum(lat for _, lat in places.values()) / len(places)
    longitude = sum(lon for lon, _ in places.values()) / len(places)
    east = EARTH_RADIUS * math.cos(math.radians(latitude))
    return {node: (east * math.radians(lon - longitude),
                   EARTH_RADIUS * math.radians(lat - latitude))
            for node, (lon, lat) in places.items()}


class Network:
    """Where a vehicle can drive for ever without turning round on the spot.

    Its elements are stretches (from node, to node), which a vehicle is on in
    one direction. Kept is the largest strongly connected set of them: dead ends
    and roads that the extract's border cuts off are not in it.
    """

    def __init__(self, roads, positions):
        self.positions = positions
        stretches = set()
        for road in roads:
            for start, end in zip(road.nodes, road.nodes[1:]):
                if positions[start] == positions[end]:
                    continue
                if road.forward:
                    stretches.add((start, end))
                if road.backward:
                    stretches.add((end, start))
        self._leaving = {}
        self._keep(stretches)
        self.stretches = self._largest_component(sorted(stretches))
        if not self.stretches:
            raise ValueError("no roads on which a vehicle can drive for ever")
        self._keep(self.stretches)

    def _keep(self, stretches):
        self._leaving = collections.defaultdict(list)
        for start, end in sorted(stretches):
            self._leaving[start].append(end)

    def length(self, stretch):
        """Metres."""
        return math.dist(*(self.positions[node] for node in stretch))

    def following(self, stretch):
        start, end = stretch
        return [(end, onward) for onward in self._leaving[end]
                if onward != start]

    def _largest_component(self, stretches):
        """Tarjan's algorithm, with its stack in a list."""
        order, low, component = {}, {}, {}
        waiting, components = [], []
        for root in stretches:
            if root in order:
                continue
            calls = [(root, iter(self.following(root)))]
            order[root] = low[root] = len(order)
            waiting.append(root)
            while calls:
                stretch, onward = calls[-1]
                for other in onward:
                    if other not in order:
                        order[other] = low[other] = len(order)
                        waiting.append(other)
                        calls.append((other, iter(self.following(other))))
                        break
                    if other not in component:
                        low[stretch] = min(low[stretch], order[other])
                else:
                    calls.pop()
                    if calls:
                        caller = calls[-1][0]
                        low[caller] = min(low[caller], low[stretch])
                    if low[stretch] == order[stretch]:
                        members = []
                        while not members or members[-1] != stretch:
                            members.append(waiting.pop())
                            component[members[-1]] = len(components)
                        components.append(members)
        # A stretch alone does not lead back to itself.
        components = [one for one in components if len(one) > 1]
        return sorted(max(components, key=len, default=[]))

    def near(self, stretch, radius):
        """Stretches that begin within `radius` metres of where this one does.
        """
        centre = self.positions[stretch[0]]
        return [other for other in self.stretches
                if math.dist(self.positions[other[0]], centre) <= radius]

    def picker(self, stretches):
        """Picks at random, each metre of road as probable as any other."""
        lengths = list(itertools.accumulate(map(self.length, stretches)))

        def pick(rng):
            at = bisect.bisect(lengths, rng.random() * lengths[-1])
            return stretches[min(at, len(stretches) - 1)]
        return pick

    def shortest_way(self, start, goal):
        """Stretches from behind `start` to `goal`; none if they are one."""
        best, before = {start: 0.0}, {}
        queue, done = [(0.0, start)], set()
        while queue:
            distance, stretch = heapq.heappop(queue)
            if stretch in done:
                continue
            if stretch == goal:
                break
            done.add(stretch)
            for onward in self.following(stretch):
                further = distance + self.length(onward)
                if further < best.get(onward, math.inf):
                    best[onward] = further
                    before[onward] = stretch
                    heapq.heappush(queue, (further, onward))
        way = []
        while goal != start:
            way.append(goal)
            goal = before[goal]
        return way[::-1]


def drive_middles(network, radius, rng):
    """Points along the middle of the roads, each metre, for ever.

    Yields (x, y, direction x, direction y). Destinations lie within `radius`
    metres of the start; the way to them may lead outside.
    """
    pick = network.picker(network.stretches)
    starts = [pick(rng) for _ in range(START_DRAWS)]
    nears = [network.near(start, radius) for start in starts]
    near = max(nears, key=lambda one: sum(map(network.length, one)))
    here = starts[nears.index(near)]
    pick = network.picker(near)
    left = 0.0  # metres until the next point
    stretches = [here]
    while True:
        for stretch in stretches:
            (x, y), (end_x, end_y) = (network.positions[node]
                                      for node in stretch)
            length = network.length(stretch)
            along = ((end_x - x) / length, (end_y - y) / length)
            while left < length:
                yield (x + left * along[0], y + left * along[1], *along)
                left += STEP
            left -= length
            here = stretch
        stretches = network.shortest_way(here, pick(rng))


def normal(rng):
    """A draw of the standard normal distribution.

    It is made from random() alone, since Python promises the same numbers in
    all versions for that one only.
    """
    return (math.sqrt(-2.0 * math.log(1.0 - rng.random()))
            * math.cos(2.0 * math.pi * rng.random()))


def lane(middles, rng):
    """Points of the lane beside the road's middle, with the wander."""
    keep = math.exp(-STEP / WANDER_LENGTH)
    wander = WANDER * normal(rng)
    for x, y, along_x, along_y in middles:
        offset = LANE_OFFSET + wander
        yield x + offset * along_y, y - offset * along_x
        wander = (keep * wander
                  + WANDER * math.sqrt(1.0 - keep * keep) * normal(rng))


def steer(points, count):
    """`count` poses, each metre, of a vehicle that pursues the points.

    It drives arcs to the first point that is LOOK_AHEAD away, or of the least
    radius where that is too tight. The point that it has passed moves on by
    half a step at least, so that a vehicle cannot circle about one point for
    ever, and what it cannot reach is left out.
    """
    points = iter(points)
    ahead = collections.deque(itertools.islice(points, 4))
    (x, y), toward = ahead[0], ahead[-1]
    heading = math.atan2(toward[1] - y, toward[0] - x)
    poses = [Pose(x, y, heading)]
    passed = 0.0
    while len(poses) < count:
        # Points that are nearer than the one before have been passed.
        passed += 0.5
        while passed >= 1.0 or (
                len(ahead) > 1 and math.dist(ahead[1], (x, y))
                <= math.dist(ahead[0], (x, y))):
            ahead.popleft()
            passed = max(0.0, passed - 1.0)
            if len(ahead) < 2:
                ahead.append(next(points))
        target = 0
        while math.dist(ahead[target], (x, y)) < LOOK_AHEAD:
            target += 1
            if target == len(ahead):
                ahead.append(next(points))
        distance = math.dist(ahead[target], (x, y))
        aside = math.atan2(ahead[target][1] - y,
                           ahead[target][0] - x) - heading
        # A point behind is reached by turning as tightly as can be, too.
        aside = math.remainder(aside, 2.0 * math.pi)
        curvature = (2.0 * math.sin(aside) / distance
                     if abs(aside) < math.pi / 2
                     else math.copysign(1.0 / LEAST_RADIUS, aside))
        curvature = max(-1.0 / LEAST_RADIUS,
                        min(1.0 / LEAST_RADIUS, curvature))
        turn = curvature * STEP
        # An arc's chord points half-way between its two headings.
        chord = STEP * (1.0 if abs(turn) < 1e-9
                        else math.sin(turn / 2.0) / (turn / 2.0))
        x += chord * math.cos(heading + turn / 2.0)
        y += chord * math.sin(heading + turn / 2.0)
        heading = math.remainder(heading + turn, 2.0 * math.pi)
        poses.append(Pose(x, y, heading))
    return poses


def drive_on_map(network, length, seed, radius=math.inf):
    """The true poses of a drive of `length` metres, in the frame of the map."""
    rng = random.Random(seed)
    # The wander has numbers of its own, so that it does not decide the way.
    wander = random.Random(rng.random())
    return steer(lane(drive_middles(network, radius, rng), wander),
                 math.ceil(length / STEP) + 1)


def drive(network, length, seed, radius=math.inf):
    """The same, but beginning at 0, 0."""
    poses = drive_on_map(network, length, seed, radius)
    return [Pose(pose.x - poses[0].x, pose.y - poses[0].y, pose.heading)
            for pose in poses]


def dead_reckon(truth, seed, noise_scale=1.0, gyro_bias=0.0):
    """The poses that an odometer estimates along the truth.

    `gyro_bias` is the error of the heading's rate, radians per second.
    """
    rng = random.Random(f"estimate {seed}")

    def noise(deviation):
        return noise_scale * deviation * normal(rng)

    before = truth[0]
    x = before.x + noise(START_POSITION)
    y = before.y + noise(START_POSITION)
    heading = before.heading + noise(START_HEADING)
    poses = [Pose(x, y, math.remainder(heading, 2.0 * math.pi))]
    for pose in truth[1:]:
        step_x, step_y = pose.x - before.x, pose.y - before.y
        turn = math.remainder(pose.heading - before.heading, 2.0 * math.pi)
        half_way = before.heading + turn / 2.0
        root = math.sqrt(math.hypot(step_x, step_y))
        along = (step_x * math.cos(half_way) + step_y * math.sin(half_way)
                 + noise(ALONG * root))
        across = (-step_x * math.sin(half_way) + step_y * math.cos(half_way)
                  + noise(ACROSS * root))
        # Half of the heading's own error counts already within the step.
        turn += noise(HEADING * root) + gyro_bias * STEP / SPEED
        direction = heading + turn / 2.0
        x += along * math.cos(direction) - across * math.sin(direction)
        y += along * math.sin(direction) + across * math.cos(direction)
        heading += turn
        poses.append(Pose(x, y, math.remainder(heading, 2.0 * math.pi)))
        before = pose
    return poses


def write_drive(path, truth, estimate):
    with open(path, "w", encoding="ascii", newline="\n") as file:
        file.write(HEADER + "\n")
        for frame, (true, estimated) in enumerate(zip(truth, estimate)):
            file.write(f"{frame},{frame * STEP / SPEED:.3f},"
                       f"{true.x:.3f},{true.y:.3f},{true.heading:.6f},"
                       f"{estimated.x:.3f},{estimated.y:.3f},"
                       f"{estimated.heading:.6f}\n")


def positive(argument):
    value = float(argument)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError("must be positive")
    return value


def main():
    parser = argparse.ArgumentParser(
        description=__doc__.split("\n\n", maxsplit=1)[0],
        epilog="Extracts are (c) OpenStreetMap contributors, ODbL 1.0.")
    parser.add_argument("extract", type=pathlib.Path,
                        metavar="EXTRACT.osm.pbf")
    parser.add_argument("--length-km", type=positive, default=28.0,
                        help="length of the drive (28)")
    parser.add_argument("--seed", type=int, default=1,
                        help="a seed gives the same drive each time (1)")
    parser.add_argument("--radius-km", type=positive, default=1.0,
                        help="destinations lie this near to the start (1)")
    parser.add_argument("--noise-scale", type=float, default=1.0,
                        help="the estimate's noise, times this (1)")
    parser.add_argument("--gyro-bias-deg-s", type=float, default=0.0,
                        help="constant error of the heading's rate, degrees "
                             "per second (0)")
    parser.add_argument("--vehicles", type=int, metavar="N",
                        help="as many drives in the frame of the map")
    parser.add_argument("--out", type=pathlib.Path, required=True,
                        metavar="DRIVE.csv")
    options = parser.parse_args()

    try:
        roads, places = read_roads(options.extract)
        network = Network(roads, project(places))
    except ImportError:
        sys.exit("Reading an extract needs the package osmium: "
                 "pip install osmium")
    except (OSError, RuntimeError, ValueError) as error:
        sys.exit(f"{options.extract}: {error}")

    def write(path, make, seed):
        truth = make(network, 1000.0 * options.length_km, seed,
                     1000.0 * options.radius_km)
        write_drive(path, truth, dead_reckon(
            truth, seed, options.noise_scale,
            math.radians(options.gyro_bias_deg_s)))

    if options.vehicles is None:
        write(options.out, drive, options.seed)
    for k in range(options.vehicles or 0):
        write(options.out.with_stem(f"{options.out.stem}-{k + 1}"),
              drive_on_map, options.seed + k)


if __name__ == "__main__":
    main()
