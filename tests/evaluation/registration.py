"""Truths of several drives of one town in one frame, where each was published in a
frame of its own: the paths are laid over each other where the same streets were driven.

Truths that were computed by SLAM, each for itself, bend: laid over each other as they
are, those of MulRan's DCC lie up to 12 m apart on one lane. So a path is also shifted
by what differs along it, slowly. Nothing is known of the estimates here.
"""

import csv
import math

import numpy as np

#: Paths are compared at points this far apart, in metres.
SPACING = 10.0
#: A stretch of so many points has a shape that tells where it lies.
WINDOW = 40
#: Two points are of one street within so many metres and radians.
NEAR, ALIKE = 10.0, math.radians(30.0)
#: Least share of the points that have to be, or the drives share too little.
LEAST_SHARE = 0.1
#: How far apart two passes of one lane lie, and how much the shift of a path changes
#: from one point to the next, as standard deviations in metres.
LANE, CHANGE = 1.0, 0.2


def travelled(rows):
    """How far a drive has gone at each of its poses, by its truth."""
    x, y = (np.array([float(row[name]) for row in rows]) for name in ("gt_x", "gt_y"))
    return np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])


def path_of(rows):
    """Points (x, y, heading) at even distances along the truth of a drive."""
    along = travelled(rows)
    goes = np.concatenate([[True], np.diff(along) > 0.0])
    at = np.arange(0.0, along[-1], SPACING)
    points = np.column_stack([
        np.interp(at, along[goes],
                  np.array([float(row[name]) for row in rows])[goes])
        for name in ("gt_x", "gt_y")])
    steps = np.diff(points, axis=0, append=2 * points[-1:] - points[-2:-1])
    return np.column_stack([points, np.arctan2(steps[:, 1], steps[:, 0])])


def fitted(points, onto):
    """The turn and the move that lay points best onto others, and how far from these
    they then lie (the root of the mean square)."""
    middle, target = points.mean(axis=0), onto.mean(axis=0)
    covariance = (points - middle).T @ (onto - target)
    turn = math.atan2(covariance[0, 1] - covariance[1, 0],
                      covariance[0, 0] + covariance[1, 1])
    move = target - rotation(turn) @ middle
    left = onto - (points @ rotation(turn).T + move)
    return turn, move, math.sqrt(float((left ** 2).sum(axis=1).mean()))


def rotation(turn):
    c, s = math.cos(turn), math.sin(turn)
    return np.array([[c, -s], [s, c]])


def moved(path, turn, move):
    return np.column_stack([path[:, :2] @ rotation(turn).T + move, path[:, 2] + turn])


def pairs_on(path, reference, near):
    """Points of a path and those of the reference that are of the same street, passed
    the same way: the indices of both."""
    apart = np.hypot(path[:, None, 0] - reference[None, :, 0],
                     path[:, None, 1] - reference[None, :, 1])
    turned = path[:, None, 2] - reference[None, :, 2]
    apart[np.abs(np.angle(np.exp(1j * turned))) > ALIKE] = np.inf
    nearest = apart.argmin(axis=1)
    rows = np.flatnonzero(apart[np.arange(len(path)), nearest] <= near)
    return rows, nearest[rows]


def coarse(path, reference):
    """Every turn and move that lays a bent stretch of the path onto the reference."""
    for begin in range(0, len(path) - WINDOW, WINDOW // 8):
        stretch = path[begin:begin + WINDOW, :2]
        if np.linalg.svd(stretch - stretch.mean(axis=0), compute_uv=False)[1] < 100.0:
            continue
        for at in range(len(reference) - WINDOW):
            turn, move, left = fitted(stretch, reference[at:at + WINDOW, :2])
            if left < NEAR:
                yield turn, move


def register(path, reference):
    """The turn and the move that lay a path onto the reference. ValueError if they
    share too few streets."""
    best, most = None, 0
    for turn, move in coarse(path, reference):
        count = len(pairs_on(moved(path, turn, move), reference, NEAR)[0])
        if count > most:
            best, most = (turn, move), count
    if most < LEAST_SHARE * len(path):
        raise ValueError("the drives share too few streets to be laid over each other")
    turn, move = best
    for near in (15.0, 15.0, 10.0, 10.0, 8.0, 8.0, *[6.0] * 20):
        placed = moved(path, turn, move)
        rows, nearest = pairs_on(placed, reference, near)
        off, across = beside(placed[rows], reference[nearest])
        onto = placed[rows, :2] + off[:, None] * across
        turn, move, _ = fitted(path[rows, :2], onto)
    return turn, move


def beside(points, reference):
    """How far the reference lies to the left of each point, and that direction: along
    the street, a point may lie anywhere between two of the reference."""
    across = np.column_stack([-np.sin(reference[:, 2]), np.cos(reference[:, 2])])
    return ((reference[:, :2] - points[:, :2]) * across).sum(axis=1), across


def shifts(path, reference):
    """The shift (x, y) of each point of a path that lies on the reference nearly, and
    how far apart the two then are (the median of what lies beside, in metres)."""
    count = len(path)
    shift = np.zeros((count, 2))
    smooth = np.diff(np.eye(count), axis=0)
    smooth = smooth.T @ smooth / CHANGE ** 2
    for near in (15.0, 15.0, 12.0, *[8.0] * 7):
        placed = np.column_stack([path[:, :2] + shift, path[:, 2]])
        rows, nearest = pairs_on(placed, reference, near)
        off, across = beside(placed[rows], reference[nearest])
        system = np.kron(smooth, np.eye(2)) + 1e-9 * np.eye(2 * count)
        wanted = np.zeros(2 * count)
        for row, left, direction in zip(rows, off, across):
            part = slice(2 * row, 2 * row + 2)
            system[part, part] += np.outer(direction, direction) / LANE ** 2
            wanted[part] += (left + direction @ shift[row]) * direction / LANE ** 2
        shift = np.linalg.solve(system, wanted).reshape(count, 2)
    return shift, float(np.median(np.abs(off)))


def read(path):
    with open(path, encoding="ascii") as file:
        return list(csv.DictReader(file))


def write_registered(drives, folder):
    """Copies of the drive files below the folder, with their truths in the frame of the
    first one's; with how far apart the truths are on the streets that they share."""
    reference = path_of(read(drives[0]))
    written, apart = [drives[0]], [0.0]
    for drive in drives[1:]:
        rows = read(drive)
        path = path_of(rows)
        turn, move = register(path, reference)
        shift, off = shifts(moved(path, turn, move), reference)
        at = travelled(rows) / SPACING
        along = np.arange(len(shift))
        for row, dx, dy in zip(rows, np.interp(at, along, shift[:, 0]),
                               np.interp(at, along, shift[:, 1])):
            x, y = rotation(turn) @ [float(row["gt_x"]), float(row["gt_y"])] + move
            row.update(gt_x=f"{x + dx:.3f}", gt_y=f"{y + dy:.3f}",
                       gt_yaw=f"{float(row['gt_yaw']) + turn:.5f}")
        out = folder / drive.name
        with open(out, "w", encoding="ascii", newline="") as file:
            writer = csv.DictWriter(file, rows[0], lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        written.append(out)
        apart.append(off)
    return written, apart
