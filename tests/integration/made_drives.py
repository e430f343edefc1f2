"""Files of drives whose truth is known, for `revisit evaluate`."""

import math

import numpy as np


def square(laps, step_meters=2.0, lap_meters=600.0):
    """Poses (x, y, heading) of a square that is driven again and again."""
    side = lap_meters / 4.0
    for number in range(int(laps * lap_meters / step_meters)):
        corner, along = divmod(number * step_meters % lap_meters, side)
        yield ((along, side, side - along, 0.0)[int(corner)],
               (0.0, along, side, side - along)[int(corner)],
               math.remainder(corner * math.pi / 2.0, math.tau))


def write_drive(path, laps, step_meters=2.0, lap_meters=600.0,
                climb_meters=None):
    """That square; the estimate is the truth. Each lap ends so much higher than
    it began; without that, the file has no heights."""
    poses = list(square(laps, step_meters, lap_meters))
    climb = None if climb_meters is None else climb_meters * laps / len(poses)
    rows = ["t_s,gt_x,gt_y,gt_yaw,est_x,est_y,est_yaw"
            + ("" if climb is None else ",gt_z,est_z")]
    for number, (x, y, heading) in enumerate(poses):
        pose = f"{x:.3f},{y:.3f},{heading:.6f}"
        z = "" if climb is None else f",{number * climb:.3f}"
        rows.append(f"{number},{pose},{pose}{2 * z}")
    path.write_text("\n".join(rows) + "\n")
    return path


def write_filtered_drive(path, laps, with_transitions=True):
    """That square as a filter has it that knows no fixes: dead reckoning with
    0.1 m along, 0.05 m across and 0.1 degree per square root of a metre."""
    names = [a + b for a in "xyt" for b in "xyt"]
    rows = ["t_s,gt_x,gt_y,gt_yaw,est_x,est_y,est_yaw,pxx,pxy,pxt,pyy,pyt,ptt"
            + "".join(f",f{name}" for name in names if with_transitions)]
    covariance = np.diag([0.01, 0.01, 1e-4])
    before = None
    for number, pose in enumerate(square(laps)):
        step = np.zeros(3) if before is None else np.subtract(pose, before)
        transition = np.eye(3)
        transition[:2, 2] = -step[1], step[0]
        length = math.hypot(*step[:2])
        along, across = np.array([0.1, 0.05]) ** 2 * length
        # The sides of the square are those of the frame.
        if abs(step[1]) > abs(step[0]):
            along, across = across, along
        covariance = transition @ covariance @ transition.T + np.diag(
            [along, across, math.radians(0.1) ** 2 * length])
        numbers = [*pose, *pose, *covariance[np.triu_indices(3)],
                   *(transition.ravel() if with_transitions else ())]
        rows.append(",".join(map(repr, map(float, [number, *numbers]))))
        before = pose
    path.write_text("\n".join(rows) + "\n")
    return path


def write_gnss_laps(folder):
    """Two laps of a block, one recorded a year after the other: RTKLIB's solution
    and the reference of each."""
    header = ("%  GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) "
              "sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s) ratio vn(m/s) "
              "ve(m/s) vu(m/s) sdvn sdve sdvu sdvne sdveu sdvun")
    side, speed = 200.0, 8.0
    names = []
    for year, week in ((2023, 2270), (2024, 2322)):
        fixes, reference = [header], [
            "GPS TOW (s),GPS Week,Latitude (deg),Longitude (deg),"
            "Ellipsoid Height (m),Heading (deg)"]
        day = "2023/07/11" if year == 2023 else "2024/07/09"
        for second in range(int(4 * side / speed)):
            corner, along = divmod(second * speed, side)
            east = (along, side, side - along, 0.0)[int(corner)]
            north = (0.0, along, side, side - along)[int(corner)]
            heading = corner * math.pi / 2.0
            latitude = 35.0 + north / 110941.0
            longitude = 137.0 + east / 91288.0
            ve, vn = speed * math.cos(heading), speed * math.sin(heading)
            fixes.append(
                f"{day} 00:{second // 60:02}:{second % 60:02}.000 "
                f"{latitude:.9f} {longitude:.9f} 50.0 5 9 2.0 2.0 4.0 0.1 0.1 "
                f"0.1 0.0 0.0 {vn:.5f} {ve:.5f} 0.0 0.1 0.1 0.2 0.01 0.01 0.01")
            # Tuesday.
            reference.append(
                f"{2 * 86400 + second}, {week}, {latitude:.9f}, "
                f"{longitude:.9f}, 50.0, {90.0 - math.degrees(heading):.3f}")
        for name, ending, lines in (("spp", "pos", fixes),
                                    ("reference", "csv", reference)):
            path = folder / f"{name}_{year}.{ending}"
            path.write_text("\n".join(lines) + "\n")
            names.append(path)
    return names
