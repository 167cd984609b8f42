# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Out-of-sample accuracy of body poses, their motion and joint angles.

The generator shares no code with the package: rigs, projection, bodies and motion are created here
with scipy's rotations. Each figure is compared with its Cramer-Rao bound, from finite differences,
or with the best Butterworth filter, whose cutoff is chosen using the truth. Writes a
section of docs/how_good.md: python -m benchmarks.bodies
"""

from __future__ import annotations

import argparse
import textwrap
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, filtfilt
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.bodies.body import Body, BodyPoses
from fluoro_calib_ros.bodies.joints import Joint, joint_motion
from fluoro_calib_ros.bodies.tracking import BodyTracker, poses_alone, poses_of
from fluoro_calib_ros.photogrammetry.rig_orientation import RigOrientation
from fluoro_calib_ros.reconstruction.intersection import Intersector
from fluoro_calib_ros.reconstruction.reconstruct import (
    CorrectedView,
    IntersectedViews,
    intersect_exposure,
)
from tools.sections import write_section

RATE_HZ = 250.0
CUTOFFS_HZ = np.geomspace(1.5, 110, 40)


@dataclass(frozen=True)
class Rig:
    """Views at given angles about the vertical axis; distances from the source [mm]."""

    angles_deg: tuple[float, ...]
    object_mm: float = 1000.0
    principal_px: float = 3300.0

    def orientation(self) -> RigOrientation:
        """Return the exact orientation of the rig as an object of the package."""
        count = len(self.angles_deg)
        names = tuple('abcd'[:count])
        return RigOrientation(
            names,
            np.tile([511.5, 511.5, self.principal_px], (count, 1)),
            np.array([turn for turn, _ in self.views()]),
            np.array([source for _, source in self.views()]),
            np.zeros((9 * count, 9 * count)),
            'rig',
            'capture',
            names,
        )

    def views(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the rotations from rig to sensor, and the sources."""
        out = []
        for angle in self.angles_deg:
            turn = Rotation.from_euler('y', -angle, degrees=True).as_matrix()
            out.append((turn, turn.T @ np.array([0.0, 0.0, -self.object_mm])))
        return out

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return image points (F, n, 2) of points (n, 3)."""
        out = []
        for turn, source in self.views():
            x, y, z = turn @ (points - source).T
            out.append(511.5 + self.principal_px * np.stack([x / z, y / z], axis=1))
        return np.array(out)

    def bound(
        self, xyz: np.ndarray, rotation: Rotation, place: np.ndarray, sd: float
    ) -> np.ndarray:
        """Return the Cramer-Rao covariance (6, 6) of a pose about the centre of markers (m, 3)."""

        def image(d: np.ndarray) -> np.ndarray:
            turned = (Rotation.from_rotvec(d[3:]) * rotation).apply(xyz)
            return self.project(turned + place + d[:3]).ravel()

        step = np.repeat([1e-3, 1e-6], 3)
        columns = [
            (image(step[k] * np.eye(6)[k]) - image(-step[k] * np.eye(6)[k])) / (2 * step[k])
            for k in range(6)
        ]
        derivatives = np.array(columns).T
        return sd**2 * np.linalg.inv(derivatives.T @ derivatives)


def seen_by(rig: Rig, ids: np.ndarray, uv: np.ndarray, sd: float) -> IntersectedViews:
    """Return the views of image points (F, n, 2); NaN marks lost points."""
    count = len(ids)
    views = [
        CorrectedView(ids, of_view, np.full(count, sd), np.zeros(count), np.zeros(count, bool))
        for of_view in uv
    ]
    return intersect_exposure(views, Intersector(rig.orientation(), 4.0))


# Single exposures.

FLAG = Rig((0.0, 60.0), object_mm=1000.0, principal_px=4500.0)


def single_exposures(rng: np.random.Generator, trials: int) -> Iterable[list[str]]:
    """Yield table rows: RMSE of single exposures relative to the bound, and NSE."""
    cases = [
        (markers, views, noise)
        for markers, views, noise in ((3, 2, 0.25), (4, 2, 0.25), (6, 2, 0.25), (12, 2, 0.25))
    ] + [(4, 3, 0.25), (6, 1, 0.25), (12, 1, 0.25)]
    for markers, views, noise in cases:
        squares = []
        bounds = []
        normalised = []
        for _ in range(trials):
            rig = Rig(tuple(rng.uniform(40, 90, views).cumsum() - 60))
            error, bound, claimed = one_pose(rig, rng, markers, noise)
            squares.append(error**2)
            bounds.append(np.diagonal(bound))
            normalised.append(error @ np.linalg.solve(claimed, error) / 6)
        ratio = np.sqrt(np.mean(squares, axis=0) / np.mean(bounds, axis=0))
        rmse = np.sqrt(np.mean(squares, axis=0))
        yield [
            str(markers),
            str(views),
            f'{np.sqrt(np.mean(rmse[:3] ** 2)):.3f}',
            f'{np.degrees(np.sqrt(np.mean(rmse[3:] ** 2))):.3f}',
            f'{np.sqrt(np.mean(ratio[:3] ** 2)):.2f}',
            f'{np.sqrt(np.mean(ratio[3:] ** 2)):.2f}',
            f'{np.mean(normalised):.2f}',
        ]


def one_pose(
    rig: Rig, rng: np.random.Generator, markers: int, noise: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the error (6,), bound and claimed covariance (6, 6) of a random pose."""
    xyz = spread(rng, markers)
    rotation = Rotation.random(random_state=rng)
    place = rng.uniform(-30, 30, 3)
    # A body that is seen in one view only needs a previous exposure to locate it.
    tracker = BodyTracker(
        rig.orientation(), [Body('body', np.arange(markers), xyz, 0 * xyz[:, 0])]
    )
    uv = rig.project(rotation.apply(xyz) + place)
    if len(rig.angles_deg) == 1:
        both = Rig((rig.angles_deg[0], rig.angles_deg[0] + 80))
        return from_one_view(both, rng, (xyz, rotation, place), noise)
    frame = tracker.add(
        seen_by(rig, np.arange(markers), uv + rng.normal(0, noise, uv.shape), noise), 0, 1
    )
    assert frame is not None
    return (
        pose_error(frame, rotation, place),
        rig.bound(xyz, rotation, place, noise),
        (frame.frame.covariance_noise[0]),
    )


def from_one_view(
    rig: Rig,
    rng: np.random.Generator,
    body: tuple[np.ndarray, Rotation, np.ndarray],
    noise: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the same for a body whose second view is lost after one exposure."""
    xyz, rotation, place = body
    ids = np.arange(len(xyz))
    tracker = BodyTracker(rig.orientation(), [Body('body', ids, xyz, 0 * xyz[:, 0])])
    uv = rig.project(rotation.apply(xyz) + place)
    tracker.add(seen_by(rig, ids, uv + rng.normal(0, noise, uv.shape), noise), 0, 1)
    uv = uv + rng.normal(0, noise, uv.shape)
    uv[1] = np.nan
    # So much later that the first exposure contributes little information.
    frame = tracker.add(seen_by(rig, ids, uv, noise), 1, 5_000_000)
    assert frame is not None and frame.frame.alone[0]
    alone = Rig(rig.angles_deg[:1])
    error = np.concatenate(
        [
            frame.frame.centre_mm[0] - place - rotation.apply(xyz.mean(axis=0)),
            (Rotation.from_matrix(frame.frame.rotation[0]) * rotation.inv()).as_rotvec(),
        ]
    )
    return (
        error,
        centred_bound(alone, xyz, rotation, place, noise),
        (frame.frame.covariance_noise[0]),
    )


def pose_error(frame: object, rotation: Rotation, place: np.ndarray) -> np.ndarray:
    """Return the error (6,) of the first body of an exposure."""
    found = frame.frame  # type: ignore[attr-defined]
    turn = Rotation.from_matrix(found.rotation[0])
    return np.concatenate([found.centre_mm[0] - place, (turn * rotation.inv()).as_rotvec()])


def centred_bound(
    rig: Rig, xyz: np.ndarray, rotation: Rotation, place: np.ndarray, sd: float
) -> np.ndarray:
    """Return the bound about the centre of the markers."""
    middle = xyz.mean(axis=0)
    return rig.bound(xyz - middle, rotation, place + rotation.apply(middle), sd)


def spread(rng: np.random.Generator, markers: int) -> np.ndarray:
    """Draw centred markers (m, 3) within 30 mm that are not nearly collinear."""
    while True:
        xyz = rng.uniform(-15, 15, (markers, 3))
        xyz -= xyz.mean(axis=0)
        if np.linalg.svd(xyz, compute_uv=False)[1] > 15:
            return xyz


# Motion.

PARTS = (slice(0, 3), slice(3, 6))


def gait(t: np.ndarray) -> np.ndarray:
    """Return six harmonics at one step per second [mm]."""
    size = (60, 20, 7, 3, 1.5, 0.7)
    return np.asarray(sum(a * np.sin(2 * np.pi * (k + 1) * t + k) for k, a in enumerate(size)))


def chewing(t: np.ndarray) -> np.ndarray:
    """Return four harmonics of 1.6 Hz [mm]."""
    size = (6, 2.5, 0.7, 0.25)
    return np.asarray(sum(a * np.sin(3.2 * np.pi * (k + 1) * t + k) for k, a in enumerate(size)))


def reach(t: np.ndarray) -> np.ndarray:
    """Return three minimum-jerk movements of 0.2 s, from rest to rest [mm]."""
    out = np.zeros_like(t)
    for start, size in ((0.4, 80.0), (0.9, -60.0), (1.4, 40.0)):
        s = np.clip((t - start) / 0.2, 0, 1)
        out += size * (10 * s**3 - 15 * s**4 + 6 * s**5)
    return out


def landing(t: np.ndarray) -> np.ndarray:
    """Return a fall followed by damped oscillations of 11 and 28 Hz [mm]."""
    s = np.clip(t - 1.0, 0, None)
    hit = 8 * np.exp(-s / 0.06) * np.sin(22 * np.pi * s)
    hit += 4 * np.exp(-s / 0.02) * np.sin(56 * np.pi * s)
    return np.asarray(-150 * np.clip(t - 0.6, 0, 0.4) ** 2 - np.where(s > 0, hit, 0))


MOTIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    'gait': gait,
    'chewing': chewing,
    'reach': reach,
    'landing': landing,
}


@dataclass(frozen=True)
class Recorded:
    """Errors (T, 6) of a body in a trial, smoothed and live; normalised squared errors (T,)."""

    smoothed: np.ndarray
    squares: np.ndarray
    ratio: np.ndarray  # mean squares of position and rotation, ours and with best cutoffs
    live: np.ndarray
    live_squares: np.ndarray


def record(motion: Callable[[np.ndarray], np.ndarray], lost: float, seed: int) -> list[Recorded]:
    """Track two bodies of four markers through a trial."""
    rng = np.random.default_rng(seed)
    rig = Rig((0.0, 60.0))
    t = np.arange(0, 2, 1 / RATE_HZ)
    shapes = [spread(rng, 4) for _ in range(2)]
    bodies = [
        Body(f'bone {k}', 10 * k + np.arange(4), x, 0 * x[:, 0]) for k, x in enumerate(shapes)
    ]
    ids = np.concatenate([body.target_id for body in bodies])
    turns = []
    places = []
    for k in range(2):
        path = [motion(t + 0.02 * j + 0.1 * k) * s for j, s in enumerate((1.0, 0.6, 0.3))]
        places.append(np.stack(path, axis=1) + [0, 45 * k, 0])
        angle = np.stack([motion(t + 0.01 + 0.03 * j) for j in range(3)], axis=1)
        turns.append(Rotation.from_rotvec(angle * np.array([1, 0.3, 0.2]) / 120))
    trackers = [BodyTracker(rig.orientation(), bodies, lag=lag) for lag in (None, 0)]
    live = []
    for k in range(len(t)):
        points = np.concatenate(
            [turn[k].apply(x) + place[k] for turn, x, place in zip(turns, shapes, places)]
        )
        uv = rig.project(points) + rng.normal(0, 0.25, (2, len(ids), 2))
        uv[rng.random((2, len(ids))) < lost] = np.nan
        exposure = seen_by(rig, ids, uv, 0.25)
        trackers[0].add(exposure, k, 1 + round(1e9 * t[k]))
        live.append(trackers[1].add(exposure, k, 1 + round(1e9 * t[k])))
    exposures = trackers[0].smoothed()
    out = []
    for row in range(2):
        truth = turns[row], places[row]
        error, squares = errors(poses_of(bodies, exposures)[row], *truth)
        now, now_squares = errors(poses_of(bodies, [one for one in live if one])[row], *truth)
        alone = poses_alone(bodies, exposures)[row]
        both = compared(error, alone, *truth)
        out.append(Recorded(error, squares, both, now, now_squares))
    return out


def errors(poses: BodyPoses, turn: Rotation, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return errors (T, 6) of poses, NaN where unknown, and normalised squared errors (T,)."""
    known = poses.known
    error = np.full((len(known), 6), np.nan)
    error[known, :3] = poses.position_mm[known] - place[known]
    found = Rotation.from_matrix(poses.rotation[known])
    error[known, 3:] = (found * turn[known].inv()).as_rotvec()
    squares = np.full(len(known), np.nan)
    solved = np.linalg.solve(poses.covariance[known], error[known][:, :, None])[:, :, 0]
    squares[known] = np.sum(error[known] * solved, axis=1) / 6
    return error, squares


def compared(error: np.ndarray, poses: BodyPoses, turn: Rotation, place: np.ndarray) -> np.ndarray:
    """Return mean squares (2, 2) of position and rotation, of errors and of the best filters.

    poses: single-exposure poses, the input of the Butterworth filters. Their cutoffs are chosen
    using the truth. Both are compared in the exposures from the first to the last of these poses.
    """
    sd = poses.sd[:, :3].max(axis=1)
    # As in lab practice, exclude poses from a single view, because their depth is uncertain.
    known = np.flatnonzero(poses.known & (sd < 5 * np.nanmedian(sd)))
    rows = np.arange(known[0], known[-1] + 1)
    away = (Rotation.from_matrix(poses.rotation[known]) * turn[known].inv()).as_rotvec()
    goal = np.column_stack([place, turn.as_rotvec()])
    values = np.column_stack([poses.position_mm[known], goal[known, 3:] + away])
    whole = CubicSpline(known, values)(rows)
    squares = []
    for cutoff in CUTOFFS_HZ:
        filtered = filtfilt(*butter(2, cutoff, fs=RATE_HZ), whole, axis=0) - goal[rows]
        squares.append([np.mean(filtered[:, part] ** 2) for part in PARTS])
    ours = [np.nanmean(error[rows][:, part] ** 2) for part in PARTS]
    return np.array([ours, np.min(squares, axis=0)])


def motions(trials: int) -> Iterable[list[str]]:
    """Yield table rows: smoothing compared with the best Butterworth filter, and NSE."""
    for name, motion in MOTIONS.items():
        for lost in (0.0, 0.3):
            found = [one for seed in range(trials) for one in record(motion, lost, seed)]
            ours, best = np.mean([one.ratio for one in found], axis=0)
            ratio = np.sqrt(ours / best)
            rmse = np.sqrt(np.nanmean([one.smoothed**2 for one in found], axis=(0, 1)))
            hit = slice(round(0.95 * RATE_HZ), round(1.05 * RATE_HZ))
            live = np.sqrt(np.nanmean([one.live[25:] ** 2 for one in found], axis=(0, 1)))
            yield [
                name,
                f'{100 * lost:.0f} %',
                f'{np.sqrt(np.mean(rmse[:3] ** 2)):.4f}',
                f'{np.degrees(np.sqrt(np.mean(rmse[3:] ** 2))):.4f}',
                f'{ratio[0]:.2f}',
                f'{ratio[1]:.2f}',
                f'{np.nanmean([one.squares for one in found]):.2f}',
                f'{np.nanmean([one.squares[hit] for one in found]):.2f}',
                f'{np.sqrt(np.mean(live[:3] ** 2)):.4f}',
                f'{np.nanmean([one.live_squares[25:] for one in found]):.2f}',
            ]


def joints(rng: np.random.Generator, trials: int) -> Iterable[list[str]]:
    """Yield table rows: NSE of joint angles by their distance from gimbal lock."""
    for distance in (60.0, 20.0, 10.0, 5.0):
        squares = []
        for _ in range(trials):
            rig = Rig((0.0, 60.0))
            shapes = [spread(rng, 4) for _ in range(2)]
            bodies = [
                Body(n, 10 * k + np.arange(4), x, 0 * x[:, 0])
                for k, (n, x) in enumerate(zip(('a', 'b'), shapes))
            ]
            base = Rotation.random(random_state=rng)
            angles = np.radians([rng.uniform(-40, 40), 90 - distance, rng.uniform(-40, 40)])
            turns = [base, base * Rotation.from_euler('XYZ', angles)]
            points = np.concatenate(
                [turn.apply(x) + [0, 45 * k, 0] for k, (turn, x) in enumerate(zip(turns, shapes))]
            )
            uv = rig.project(points)
            ids = np.concatenate([body.target_id for body in bodies])
            tracker = BodyTracker(rig.orientation(), bodies)
            exposure = seen_by(rig, ids, uv + rng.normal(0, 0.25, uv.shape), 0.25)
            found = tracker.add(exposure, 0, 1)
            assert found is not None
            poses = poses_alone(bodies, [found])
            motion = joint_motion(Joint('j', 'a', 'b', 'cardan_xyz'), poses[0], poses[1])
            error = (motion.angles[0] - angles + np.pi) % (2 * np.pi) - np.pi
            squares.append(error**2 / motion.sd[0, :3] ** 2)
        mean = np.mean(squares, axis=0)
        yield [f'{distance:.0f}', *(f'{value:.2f}' for value in mean)]


def jumps(frames: int) -> str:
    """Measure jumps of live poses when only one or two markers per view remain, for 2 to 80 ms."""
    rng = np.random.default_rng(5)
    rig = Rig((0.0, 60.0))
    xyz = spread(rng, 4)
    ids = np.arange(4)
    tracker = BodyTracker(rig.orientation(), [Body('body', ids, xyz, 0 * xyz[:, 0])])
    last: tuple[np.ndarray, np.ndarray] | None = None
    left = np.ones((2, 4), dtype=bool)
    until = far = count = lost = 0
    largest = 0.0
    for k in range(frames):
        t = k / RATE_HZ
        phase = 2 * np.pi * t * np.array([1.0, 1.7, 0.6])
        turn = Rotation.from_rotvec(0.4 * np.sin(phase))
        place = np.array([60, 20, 30]) * np.sin(phase + 1)
        if k >= until:
            whole = not left.all()
            left = np.ones((2, 4), dtype=bool)
            until = k + int(rng.integers(5, 100))
            if not whole:
                for view in left:
                    view[rng.permutation(4)[rng.integers(1, 3) :]] = False
                until = k + int(rng.integers(1, 20))
        uv = rig.project(turn.apply(xyz) + place) + rng.normal(0, 0.25, (2, 4, 2))
        uv[~left] = np.nan
        found = tracker.add(seen_by(rig, ids, uv, 0.25), k, 1 + round(1e9 * t))
        assert found is not None
        if not np.isfinite(found.rotation[0]).all():
            lost += 1
            last = None
            continue
        error = np.concatenate(
            [
                found.centre_mm[0] - place,
                (Rotation.from_matrix(found.rotation[0]) * turn.inv()).as_rotvec(),
            ]
        )
        covariance = found.covariance[0][:6, :6]
        if last is not None:
            jump = error - last[0]
            sd = np.sqrt(np.diagonal(covariance + last[1]))
            size = float(np.abs(jump / sd).max())
            far += size > 3
            largest = max(largest, size)
            count += 1
        last = error, covariance
    return (
        f'Four markers lost to one or two in a view, in a sixth of {frames} exposures at 250 Hz, '
        f'live: {100 * far / count:.1f} % of the changes of the error from one exposure to the '
        'next are above three standard deviations in one of six components (1.6 % of independent '
        f'Gaussian ones); the largest is {largest:.1f}. The body is lost in {lost} exposures.'
    )


def cost(exposures: int = 1000) -> str:
    """Measure CPU times of poses and intersection: five bodies of six markers, per exposure."""
    rng = np.random.default_rng(0)
    rig = Rig((0.0, 60.0))
    shapes = [spread(rng, 6) for _ in range(5)]
    bodies = [Body(f'b{k}', 10 * k + np.arange(6), x, 0 * x[:, 0]) for k, x in enumerate(shapes)]
    ids = np.concatenate([body.target_id for body in bodies])
    points = np.concatenate([x + [0, 40 * k - 80, 0] for k, x in enumerate(shapes)])
    tracker = BodyTracker(rig.orientation(), bodies)
    spent = np.zeros(2)
    for k in range(exposures):
        uv = rig.project(points) + rng.normal(0, 0.25, (2, 30, 2))
        start = time.process_time()
        exposure = seen_by(rig, ids, uv, 0.25)
        middle = time.process_time()
        tracker.add(exposure, k, 1 + round(4e6 * k))
        spent += [middle - start, time.process_time() - middle]
    points_ms, bodies_ms = 1e3 * spent / exposures
    return (
        f'Five bodies of six markers cost {bodies_ms:.2f} ms of CPU an exposure, in addition to '
        f'{points_ms:.2f} ms for the intersection of their 30 points.'
    )


def table(header: str, rows: Iterable[list[str]]) -> str:
    """Return a Markdown table, and print its rows as they are generated."""
    names = header.split('|')
    lines = [' | '.join(names), '|'.join(['---'] + ['---:'] * (len(names) - 1))]
    for row in rows:
        lines.append(' | '.join(row))
        print(lines[-1], flush=True)
    return '\n'.join(f'| {line} |' for line in lines)


TEXT = """
## Bodies and joints

Generated by `python -m benchmarks.bodies`, with rigs, bodies and motion of a generator that shares
no code with the package: views at 40 to 90 degrees to each other, markers within 30 mm, noise of
0.25 px, known distortion. NSE: mean of (error / stated sd)^2. Bound: Cramer-Rao, with derivatives
by differences.

Single exposures; with one view, the exposure after the second one was lost:

{single}

Twelve beads with the geometry of the flag of Miranda et al. (J. Biomech. Eng. 133, 2011; published
0.1 mm and 0.1 degrees): {flag}

Two bodies of four markers at 250 Hz for 2 s; lost: share of all image points that is lost.
Best Butterworth: zero-lag, with the cutoff that is best for this trial, chosen with the truth,
over poses of single exposures of two views, with gaps filled by a cubic spline; both are compared
from the first to the last of these poses. Hit: the 0.1 s about the impact, or the same interval of
the other motions. Live: without lag.

{motions}

{jumps}

Angles of a Cardan joint by their distance from gimbal lock, for single exposures:

{joints}

{cost}
"""


def main() -> None:
    """Run the measurements and write the section."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--trials', type=int, default=200, help='random rigs of a row')
    parser.add_argument('--recordings', type=int, default=4, help='recordings of a row')
    parser.add_argument('--frames', type=int, default=100_000, help='that are watched for jumps')
    arguments = parser.parse_args()
    rng = np.random.default_rng(20)
    single = table(
        'markers|views|RMSE [mm]|RMSE [deg]|position / bound|rotation / bound|NSE',
        single_exposures(rng, arguments.trials),
    )
    found = [one_pose(FLAG, rng, 12, 0.1) for _ in range(arguments.trials)]
    rmse = np.sqrt(np.mean([error**2 for error, _, _ in found], axis=0))
    bound = np.sqrt(np.mean([np.diagonal(one) for _, one, _ in found], axis=0))
    flag = (
        f'{np.sqrt(np.mean(rmse[:3] ** 2)):.3f} mm and '
        f'{np.degrees(np.sqrt(np.mean(rmse[3:] ** 2))):.3f} degrees with noise of 0.1 px, bound '
        f'{np.sqrt(np.mean(bound[:3] ** 2)):.3f} and '
        f'{np.degrees(np.sqrt(np.mean(bound[3:] ** 2))):.3f}.'
    )
    print(flag, flush=True)
    of_motion = table(
        'motion|lost|RMSE [mm]|RMSE [deg]|position / best Butterworth|rotation / best Butterworth'
        '|NSE|NSE at the hit|live RMSE [mm]|live NSE',
        motions(arguments.recordings),
    )
    of_joints = table(
        'degrees from the lock|NSE of angle 1|angle 2|angle 3', joints(rng, 5 * arguments.trials)
    )
    of_jumps = jumps(arguments.frames)
    print(of_jumps, flush=True)
    text = TEXT.format(
        single=single,
        flag=flag,
        motions=of_motion,
        jumps=textwrap.fill(of_jumps, width=99),
        joints=of_joints,
        cost=cost(),
    )
    write_section(Path('docs/how_good.md'), 'bodies', text)


if __name__ == '__main__':
    main()
