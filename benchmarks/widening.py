# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Validity of standard deviations between a change of the rig and its healing.

Streams of the generator of benchmarks.healing show a healthy rig, which then changes. Points and
poses are estimated with and without the covariance that an alarm adds. Writes a section of
docs/how_good.md: python -m benchmarks.widening --seeds 8
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from fluoro_calib_ros.bodies.body import BodyPoses
from fluoro_calib_ros.bodies.tracking import BodyTracker, TrackedExposure, poses_of
from fluoro_calib_ros.checks.drift_charts import OK
from fluoro_calib_ros.checks.rig_watch import RigDriftWatch
from fluoro_calib_ros.correction.fluoroscope_calibration import Calibrations
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.healing.diagnosis import Cause
from fluoro_calib_ros.jobs.healing import heal_rig
from fluoro_calib_ros.photogrammetry.noise import ObservedScatter
from fluoro_calib_ros.photogrammetry.rig_orientation import RigOrientation
from fluoro_calib_ros.reconstruction.intersection import Intersector
from fluoro_calib_ros.reconstruction.reconstruct import reconstruct_exposure
from tools.sections import write_section

from .bodies import table
from .healing import KNEE, NAMES, SCENARIOS, SIZE, Recording, Scenario, bump, creep, focus

RATE_HZ = 30.0
HEALTHY_S = 12.0
CHANGED_S = 8.0
AFTER_S = 5.0
PARTS = ('before', 'change', 'alarm, as before', 'alarm', 'healed')


def small_bump(rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
    """Move b by 0.25 mm and 0.025 degrees."""
    return bump(rng, times) / 20


def slight_bump(rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
    """Move b by 1 mm and 0.1 degrees."""
    return bump(rng, times) / 5


def slow_creep(rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
    """Move b gradually by 1 mm and 0.1 degrees during the recording."""
    return creep(rng, times) / 5


BUMP = next(one for one in SCENARIOS if one.name == 'bump')
CASES = (
    ('bump, 0.5 degrees and 5 mm', BUMP),
    ('bump, 0.1 degrees and 1 mm', replace(BUMP, change=slight_bump)),
    ('bump, 0.025 degrees and 0.25 mm', replace(BUMP, change=small_bump)),
    ('bump, 0.1 degrees and 1 mm, two bodies of four', replace(KNEE, change=slight_bump)),
    ('creep by 0.1 degrees and 1 mm in 8 s', replace(BUMP, change=slow_creep, is_steady=False)),
    ('principal distance, 1 %', replace(BUMP, cause=Cause.INTERIOR, change=focus)),
    (
        'distortion, 4 px',
        replace(BUMP, cause=Cause.DISTORTION, change=None, drift_px=4.0),
    ),
)


class Stream:
    """Frames of a rig that changes."""

    def __init__(self, number: int, scenario: Scenario, seed: int) -> None:
        given = Recording(BUMP if scenario.bodies == BUMP.bodies else KNEE, 1000 * number + seed)
        self.recording = given
        count = round((HEALTHY_S + CHANGED_S + AFTER_S) * RATE_HZ)
        self.times = np.arange(count) / RATE_HZ
        self.points = given.moving(self.times, 1.0)
        change = np.zeros((count, 18))
        late = self.times >= HEALTHY_S
        if scenario.change is not None:
            since = self.times[late] - HEALTHY_S
            change[late] = scenario.change(given.rng, np.append(since, CHANGED_S))[:-1]
        self.frames: dict[str, list[Frame]] = {name: [] for name in NAMES}
        false = []
        for rows, drift in ((~late, 0.0), (late, scenario.drift_px)):
            of_part = replace(scenario, drift_px=drift)
            frames, wrong = given.seen(
                self.points[rows], self.times[rows], given.errors + change[rows], of_part
            )
            false.append(wrong)
            first = len(self.frames['a'])
            for name in NAMES:
                self.frames[name] += [replace(f, number=f.number + first) for f in frames[name]]
        self.false = np.concatenate(false)
        self.is_steady = scenario.is_steady

    def rows(self, begin_s: float, end_s: float) -> slice:
        """Return the rows of the exposures in a time interval."""
        return slice(round(begin_s * RATE_HZ), round(end_s * RATE_HZ))

    def pairs(self, rows: slice) -> list[dict[str, Frame]]:
        """Return exposures as frames by fluoroscope."""
        return [dict(zip(NAMES, pair)) for pair in zip(*(self.frames[n][rows] for n in NAMES))]


class Found:
    """Normalised squared errors of points and of poses, by part of the stream."""

    def __init__(self) -> None:
        self.points: dict[str, list[float]] = defaultdict(list)
        self.poses: dict[str, list[float]] = defaultdict(list)
        self.sd_mm: dict[str, list[float]] = defaultdict(list)
        self.share: dict[str, list[float]] = defaultdict(list)
        self.delay_s: list[float] = []

    def follow(
        self,
        stream: Stream,
        rows: slice,
        rig: tuple[Calibrations, RigOrientation],
        has_watch: bool,
        alarms: np.ndarray | None = None,
    ) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
        """Return the alarm state of each exposure, and its errors of points and poses."""
        calibrations, orientation = rig
        watch = RigDriftWatch(orientation, dict.fromkeys(NAMES, SIZE)) if has_watch else None
        intersector = Intersector(orientation)
        tracker = BodyTracker(orientation, stream.recording.bodies)
        scatter = ObservedScatter()
        levels, out = [], []
        for row, exposure in zip(range(rows.start, rows.stop), stream.pairs(rows)):
            levels.append(watch is not None and watch.state.level != OK)
            wide = watch.widened(intersector)[0] if watch else intersector
            tracker.use(wide.orientation)
            found = reconstruct_exposure(exposure, calibrations, intersector, watch, scatter)
            tracked = tracker.add(found.intersected, found.number, found.stamp_ns)
            assert tracked is not None
            truth = stream.points[row].reshape(-1, 3)
            own = np.isin(found.target_id, np.arange(1000))
            at = _rows_of(stream.recording, found.target_id[own])
            good = ~stream.false[row][at] & np.isfinite(found.points.xyz_mm).all(axis=1)
            error = (found.points.xyz_mm - truth[at])[good]
            covariance = found.points.covariance[good]
            out.append(
                {
                    'points': _squares(error, covariance) / 3,
                    'sd_mm': np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3),
                    'share': np.array([good.mean()]),
                    'poses': self._poses(stream, row, tracked),
                }
            )
        return np.array(levels), out

    def _poses(self, stream: Stream, row: int, tracked: TrackedExposure) -> np.ndarray:
        bodies = stream.recording.bodies
        squares = []
        for k, pose in enumerate(poses_of(bodies, [tracked])):
            if pose.status[0] == 0:
                squares.append(_pose_square(stream, row, k, pose))
        return np.array(squares)

    def take(self, part: str, errors: Sequence[dict[str, np.ndarray]]) -> None:
        """Add the errors of exposures, as one mean per stream for each part."""
        if not errors:
            return
        for name in ('points', 'poses', 'sd_mm', 'share'):
            values = np.concatenate([one[name] for one in errors])
            if len(values):
                mean = np.median if name == 'sd_mm' else np.mean
                getattr(self, name)[part].append(float(mean(values)))


def _rows_of(recording: Recording, target_id: np.ndarray) -> np.ndarray:
    ids = np.concatenate([body.target_id for body in recording.bodies])
    return np.searchsorted(ids, target_id)


def _squares(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.sum(error * np.linalg.solve(covariance, error[..., None])[..., 0], axis=-1)


def _pose_square(stream: Stream, row: int, body: int, pose: BodyPoses) -> float:
    xyz = stream.recording.bodies[body].xyz_mm  # in the learned frame
    centre = xyz.mean(axis=0)
    truth = stream.points[row, body]
    turn = Rotation.align_vectors(truth - truth.mean(axis=0), xyz - centre)[0]
    origin = truth.mean(axis=0) - turn.apply(centre)
    rotation = (Rotation.from_matrix(pose.rotation[0]) * turn.inv()).as_rotvec()
    error = np.concatenate([pose.position_mm[0] - origin, rotation])
    return float(_squares(error, pose.covariance[0])) / 6


def measure(number: int, scenario: Scenario, seeds: Iterable[int], healed: int) -> Found:
    """Follow the streams of a scenario, and heal the first `healed` of them."""
    result = Found()
    for seed in seeds:
        stream = Stream(number, scenario, seed)
        recording = stream.recording
        rig = recording.calibrations(), recording.orientation()
        until = stream.rows(0, HEALTHY_S + CHANGED_S)
        alarms, wide = result.follow(stream, until, rig, True)
        _, plain = result.follow(stream, until, rig, False)
        first = stream.rows(HEALTHY_S, HEALTHY_S).start
        late = np.flatnonzero(alarms & (np.arange(len(alarms)) >= first))
        begin = int(late[0]) if len(late) else len(alarms)
        result.take('before', wide[:first])
        result.take('change', wide[first:begin])
        result.take('alarm', [wide[row] for row in late])
        result.take('alarm, as before', [plain[row] for row in late])
        result.delay_s.append((begin - first) / RATE_HZ if len(late) else np.inf)
        text = ''
        if stream.is_steady and seed < healed:
            rows = stream.rows(HEALTHY_S + 2, HEALTHY_S + 7)
            frames = {name: stream.frames[name][rows] for name in NAMES}
            outcome = heal_rig(frames, *rig, recording.bodies)
            text = outcome.verdict
            if outcome.verdict == 'pass':
                rows = stream.rows(HEALTHY_S + CHANGED_S, HEALTHY_S + CHANGED_S + AFTER_S)
                after = outcome.calibrations, outcome.orientation
                result.take('healed', result.follow(stream, rows, after, False)[1])
        last = {name: round(of[-1], 2) for name, of in result.points.items()}
        print(scenario.name, seed, f'{result.delay_s[-1]:.2f} s', last, text, flush=True)
    return result


TEXT = """
## Between an alarm and healing

Generated by `python -m benchmarks.widening --seeds {seeds} --healed {healed}`: streams of the
generator of [healing](#healing), as many of each change as the first option gives, with
{rate:.0f} exposures a second, of a rig that changes after {healthy:.0f} s. As many as the second
option gives are also healed, from 5 s of the stream after that.
NSE: mean squared error over the stated covariance, of points in the rig frame and of poses,
without false matches. As before: without the addition of the alarm. Alarm: median time until the
alarm. Found: share of the points that are not rejected.

{rows}
"""
HEADER = (
    'change|alarm after [s]|NSE of points before|until the alarm|alarm, as before'
    '|alarm|healed|NSE of poses before|until the alarm|alarm, as before|alarm|healed'
    '|found as before|found|sd as before [mm]|sd [mm]'
)


def cells(found: Found) -> list[str]:
    """Return the cells of a table row."""

    def mean(values: dict[str, list[float]], part: str) -> str:
        return f'{np.mean(values[part]):.2f}' if values[part] else ''

    wide = ('alarm, as before', 'alarm')
    return [
        f'{np.median(found.delay_s):.2f}',
        *(mean(found.points, part) for part in PARTS),
        *(mean(found.poses, part) for part in PARTS),
        *(mean(found.share, part) for part in wide),
        *(mean(found.sd_mm, part) for part in wide),
    ]


def main() -> None:
    """Run the measurements and write the section."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=8, help='streams of a scenario')
    parser.add_argument('--healed', type=int, default=2, help='streams that are healed, too')
    arguments = parser.parse_args()
    rows = []
    with threadpool_limits(1):
        for number, (name, scenario) in enumerate(CASES, 1):
            seeds = range(arguments.seeds)
            found = measure(number, scenario, seeds, arguments.healed)
            rows.append([name, *cells(found)])
            print('|'.join(rows[-1]), flush=True)
    text = TEXT.format(
        rows=table(HEADER, rows),
        seeds=arguments.seeds,
        healed=arguments.healed,
        rate=RATE_HZ,
        healthy=HEALTHY_S,
    )
    write_section(Path('docs/how_good.md'), 'widening', text)


if __name__ == '__main__':
    main()
