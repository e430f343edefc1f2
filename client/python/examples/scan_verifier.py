#!/usr/bin/env python3
"""A verifier that runs as a service: it watches the candidates that are stored,
compares the scans of the two places, and confirms with what it measured or rejects:
docs/verifier.md.

    scan_verifier.py --server 127.0.0.1:50051 --scans scans --cursor-file scans.cursor

A scan is a file VEHICLE/SEQUENCE.npy below the folder of scans, with the points (N, 2)
that a planar lidar saw from the pose of this sequence: x forward, y left, in metres."""

import argparse
import pathlib

import numpy as np

import revisit

#: Points farther from each other than this are not the same thing.
REACH_METERS = 1.5
#: Points that lie so near to each other fit.
FIT_METERS = 0.25
#: What a comparison has to fit to show one place, and may at most to show two.
ENOUGH, TOO_LITTLE = 0.7, 0.4
FEWEST_POINTS = 100
#: Errors that remain however well the points fit; measure your own.
POSITION_METERS, HEADING_RADIANS = 0.04, 0.003
#: Where a comparison starts: metres ahead of the match.
STARTS_METERS = (0.0, -2.0, 2.0, -4.0, 4.0)


def icp(query, matched, start, iterations=60):
    """Iterative closest points: the matrix (3, 3) that maps the points of the query
    into the frame of the match, its covariance (x, y, heading), and the share of the
    points that fit."""
    x, y, heading = start
    pose = np.array([[np.cos(heading), -np.sin(heading), x],
                     [np.sin(heading), np.cos(heading), y], [0.0, 0.0, 1.0]])
    for _ in range(iterations):
        moved = query @ pose[:2, :2].T + pose[:2, 2]
        squares = ((moved[:, np.newaxis] - matched[np.newaxis]) ** 2).sum(axis=2)
        nearest = squares.argmin(axis=1)
        distances = np.sqrt(squares[np.arange(len(query)), nearest])
        near = distances < REACH_METERS
        if near.sum() < FEWEST_POINTS:
            return pose, np.eye(3), 0.0
        # The rotation and the shift that bring these pairs together best (Arun 1987).
        here, there = moved[near], matched[nearest[near]]
        middle, target = here.mean(axis=0), there.mean(axis=0)
        left, _, right = np.linalg.svd((there - target).T @ (here - middle))
        turn = left @ np.diag([1.0, np.linalg.det(left @ right)]) @ right
        step = np.eye(3)
        step[:2, :2], step[:2, 2] = turn, target - turn @ middle
        pose = step @ pose
        if np.abs(step - np.eye(3)).max() < 1e-6:
            break
    fit = distances < FIT_METERS
    # Least squares: how much each point says of x, y and heading.
    arms = (query @ pose[:2, :2].T)[fit]
    slopes = np.zeros((len(arms), 2, 3))
    slopes[:, 0, 0] = slopes[:, 1, 1] = 1.0
    slopes[:, 0, 2], slopes[:, 1, 2] = -arms[:, 1], arms[:, 0]
    rows = slopes.reshape(-1, 3)
    covariance = np.diag([POSITION_METERS, POSITION_METERS, HEADING_RADIANS]) ** 2
    if fit.sum() >= FEWEST_POINTS:
        covariance += np.mean(distances[fit] ** 2) * np.linalg.inv(rows.T @ rows)
    return pose, covariance, fit.mean()


def compare(query, matched, is_opposite=False):
    """The best comparison of two scans, from several starts."""
    heading = np.pi if is_opposite else 0.0
    return max((icp(query, matched, (ahead, 0.0, heading))
                for ahead in STARTS_METERS), key=lambda compared: compared[2])


def scan_of(folder, vehicle, sequence):
    """The points that were seen from a pose; none if there is no scan."""
    path = folder / vehicle.removeprefix("vehicles/") / f"{sequence}.npy"
    return np.load(path) if path.exists() else np.empty((0, 2))


def decide(event, folder):
    """Looks at a candidate, and reports what is certain. Returns what it did."""
    found = event.evidence
    query = scan_of(folder, event.vehicle, found.query.sequence)
    matched = scan_of(folder, event.vehicle, found.matched.sequence)
    if min(len(query), len(matched)) < FEWEST_POINTS:
        return "no scans"
    relative, covariance, fit = compare(
        query, matched, found.direction == revisit.v1.DIRECTION_OPPOSITE)
    try:
        if fit >= ENOUGH:
            event.confirm(relative, covariance, score=fit, note="icp")
            return f"confirmed, {fit:.0%} fit"
        if fit <= TOO_LITTLE:
            event.reject(note=f"icp: {fit:.0%} fit")
            return f"rejected, {fit:.0%} fit"
    except (revisit.AlreadyExists, revisit.FailedPrecondition, revisit.NotFound,
            revisit.OutOfRange) as error:
        # Decided otherwise by somebody else, or gone with its poses or its vehicle.
        return f"left as it is: {error.reason}"
    return f"cannot tell, {fit:.0%} fit"


def verify(client, folder, cursor_file):
    """Decides what is open, and then each candidate that is found."""
    for event in client.watch(cursor_file=cursor_file, from_start=True,
                              states="open", verdicts="accepted"):
        if event.candidate is not None:
            print(f"{event.candidate.name}: {decide(event, folder)}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--server", default="127.0.0.1:50051")
    parser.add_argument("--scans", type=pathlib.Path, required=True)
    parser.add_argument("--cursor-file", type=pathlib.Path, required=True)
    arguments = parser.parse_args()
    with revisit.Client(arguments.server) as client:
        verify(client, arguments.scans, arguments.cursor_file)


if __name__ == "__main__":
    main()
