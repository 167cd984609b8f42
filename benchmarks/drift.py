# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""End-to-end test of the drift watch on virtual rigs: false alarms, delays and reported drifts.

A rig is calibrated with 15 exposures, which also give its orientation. Then 30 markers in five
rigid clusters move through it. They are corrected, checked by their epipolar residuals and
intersected as in the stream. The motions repeat, the noise does not. Frames are passed in blocks,
which makes no difference to the watch and is faster than real time.
"""

from __future__ import annotations

import argparse
import copy
import multiprocessing
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from fluoro_calib_ros.bodies.body import Body, declared_bodies
from fluoro_calib_ros.checks.drift_charts import (
    ERROR,
    OK,
    WARN,
    DriftOptions,
    DriftState,
    EpipolarObservations,
)
from fluoro_calib_ros.checks.drift_watch import DriftWatch
from fluoro_calib_ros.correction.base import CorrectionStatus
from fluoro_calib_ros.correction.fluoroscope_calibration import FluoroscopeCalibration
from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.rig_orientation import (
    orientation_and_scatter,
    orientation_of_capture,
)
from fluoro_calib_ros.photogrammetry.rig_orientation import RigOrientation
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.reconstruction.epipolar import EpipolarGeometry
from fluoro_calib_ros.reconstruction.intersection import Intersector
from fluoro_calib_ros.reconstruction.reconstruct import IntersectedViews, MatchedViews
from fluoro_calib_ros.simulation.rig import simulate_exposures, virtual_rig

from .timing import table

RATE_HZ = 120
NOISE_PX = 0.25
FALSE_MATCHES = 0.01
REJECT = 4.0
FRAMES = 30  # in a block of 0.25 s
CLUSTERS = 5
BEADS = 6
PERIOD_S = 60  # period of the motion
MOTIONS = 3
IDS = np.arange(1001, 1001 + CLUSTERS * BEADS)
SIZE = 1024
QUARTERS = {
    'upper left': (0, 0),
    'upper right': (1, 0),
    'lower left': (0, 1),
    'lower right': (1, 1),
}
WHOLE = 'whole image'
WITHIN_S = 5.0  # time within which a drift should be detected
AFTER_S = 20.0  # time after which a drift counts as not detected

# Shift (k, 2) [px] of pixels (k, 2) of a fluoroscope at a time [s].
Shift = Callable[[str, np.ndarray, float], np.ndarray]
# Observed pixels, corrected points and their systematic sd by fluoroscope, and stamps [ns].
Block = tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, np.ndarray], np.ndarray]
Result = dict[str, Any]


@dataclass(frozen=True)
class Scene:
    """A calibrated rig and its markers.

    pixels: observed pixels (frames, markers, 2) without noise, by fluoroscope.
    """

    names: tuple[str, ...]
    calibrations: Mapping[str, FluoroscopeCalibration]
    orientation: RigOrientation
    geometry: EpipolarGeometry
    intersector: Intersector
    pixels: dict[str, np.ndarray]

    @property
    def bodies(self) -> tuple[Body, ...]:
        """Return the bodies, with unknown shapes."""
        ids = IDS.reshape(CLUSTERS, BEADS).tolist()
        return declared_bodies(f'bone {i + 1}: {str(own)[1:-1]}' for i, own in enumerate(ids))

    def watch(self, options: DriftOptions | None = None, clusters: bool = True) -> DriftWatch:
        """Create a DriftWatch for the scene."""
        return DriftWatch(
            dict.fromkeys(self.names, (SIZE, SIZE)),
            options,
            self.bodies if clusters else (),
            self.orientation,
        )


def markers(rng: np.random.Generator, beads: np.ndarray, seconds: float) -> np.ndarray:
    """Return positions (frames, 30, 3) [mm] of rigid clusters on the bones of a moving joint.

    beads (5, 6, 3): shapes of the clusters [mm].
    """
    places = np.array(
        [[-8, 0, 85], [12, 10, 40], [0, -5, 0], [-10, -8, -35], [10, 5, -80]], dtype=float
    )
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    speed = rng.uniform(0.7, 1.3, 4)
    phase = rng.uniform(0, 2 * np.pi, 4)
    bend = np.deg2rad(25) * np.sin(2 * np.pi * 0.5 * speed[0] * t + phase[0])
    middle = rng.uniform(-10, 10, 3)
    sway = middle + np.stack(
        [
            70 * np.sin(2 * np.pi * 0.31 * speed[1] * t + phase[1]),
            70 * np.cos(2 * np.pi * 0.23 * speed[2] * t + phase[2]),
            42 * np.sin(speed[3] * t + phase[3]),
        ],
        axis=1,
    )
    out = []
    for number, (cluster, place) in enumerate(zip(beads, places)):
        turn = np.stack(
            [bend * (1, 1, 0.3, -1, -1)[number], 0.3 * np.sin(1.1 * t + number), np.zeros_like(t)],
            axis=1,
        )
        out.append((cluster + place) @ matrix_from_vector(turn).transpose(0, 2, 1) + sway[:, None])
    return np.concatenate(out, axis=1)


def scene(seed: int, source: str = 'exposures') -> Scene:
    """Create the scene of a rig.

    source: orientation from the 'exposures' of the calibration or a 'capture' of the phantom.
    """
    rig = virtual_rig(seed)
    exposures = simulate_exposures(rig, 15, seed).frames
    calibrations = calibrate(exposures, rig.phantom).calibrations
    if source == 'capture':
        still = simulate_exposures(rig, 1, seed + 10_000).frames
        orientation = orientation_of_capture(still, rig.phantom, calibrations)
    else:
        orientation = orientation_and_scatter(exposures, rig.phantom, calibrations)[0]
    rng = np.random.default_rng([seed, 4])
    beads = rng.uniform(-22, 22, (CLUSTERS, BEADS, 3))
    points = np.concatenate([markers(rng, beads, PERIOD_S) for _ in range(MOTIONS)])
    pixels = {
        f.name: f.distortion.distort(f.ideal(points.reshape(-1, 3))).reshape(*points.shape[:2], 2)
        for f in rig.fluoroscopes
    }
    return Scene(
        tuple(pixels),
        calibrations,
        orientation,
        EpipolarGeometry(orientation, *pixels),
        Intersector(orientation, None),
        pixels,
    )


def false_matches(rng: np.random.Generator, uv: np.ndarray) -> np.ndarray:
    """Return pixels of which a fraction FALSE_MATCHES is displaced, as if by another bead."""
    wrong = rng.random(uv.shape[:2]) < FALSE_MATCHES
    uv[wrong] += rng.uniform(-12, 12, (int(wrong.sum()), 2))
    return uv


def blocks(
    scene_: Scene, rng: np.random.Generator, first: int, count: int, drift: Shift | None = None
) -> Iterator[Block]:
    """Yield blocks of the stream: pixels, corrected points, their systematic sd, and stamps.

    first: number of the first block; drift(name, uv, time_s): shift (k, 2) [px] of
    observed pixels (k, 2) at a time [s].
    """
    total = next(iter(scene_.pixels.values())).shape[0] // FRAMES
    for number in range(first, first + count):
        rows = slice(FRAMES * (number % total), FRAMES * (number % total + 1))
        seen = {}
        corrected = {}
        systematic = {}
        for name in scene_.names:
            uv = scene_.pixels[name][rows] + rng.normal(0, NOISE_PX, (FRAMES, len(IDS), 2))
            uv = false_matches(rng, uv)
            if drift is not None:
                uv = uv + drift(name, uv.reshape(-1, 2), number * FRAMES / RATE_HZ).reshape(
                    uv.shape
                )
            found = scene_.calibrations[name].correct(uv.reshape(-1, 2), np.zeros(uv[..., 0].size))
            # Points beyond the calibrated area are omitted, as by watch_exposure.
            inside = np.where(found.status[:, None] == CorrectionStatus.OUTSIDE, np.nan, found.uv)
            seen[name] = uv.reshape(-1, 2)
            corrected[name] = inside
            systematic[name] = found.sigma
        yield (
            seen,
            corrected,
            systematic,
            (np.arange(FRAMES) + number * FRAMES) * 1_000_000_000 // RATE_HZ,
        )


def feed(scene_: Scene, watch: DriftWatch, block: Block, clusters: bool = True) -> DriftState:
    """Pass a block of the stream to the watch; return the state of the watch."""
    seen, corrected, systematic, stamps = block
    a, b = scene_.names
    noise = [scene_.calibrations[name].image_sd for name in scene_.names]
    found = scene_.geometry.residuals(corrected[a], corrected[b], systematic[a], systematic[b])
    sd_noise = np.hypot(found.factor_a * noise[0], found.factor_b * noise[1])
    good = np.abs(found.residual) <= REJECT * np.hypot(sd_noise, found.sd_total)
    systematic_and_noise = replace(found, sd_total=np.hypot(sd_noise, found.sd_total))
    residuals = EpipolarObservations(
        **vars(systematic_and_noise),
        target_id=np.tile(IDS, FRAMES),
        uv_a=seen[a],
        uv_b=seen[b],
        noise=sd_noise**2,
    )
    state = watch.add_residuals(stamps[0], 0, residuals)
    if clusters:
        uv = np.stack([corrected[a], corrected[b]])
        uv[:, ~good] = np.nan
        correction = np.stack([systematic[a], systematic[b]])
        for k, stamp in enumerate(stamps):
            rows = slice(k * len(IDS), (k + 1) * len(IDS))
            sd = correction[:, rows]
            state = watch.add_points(stamp, intersected(scene_, uv[:, rows], sd, noise))
    return state


def intersected(
    scene_: Scene, uv: np.ndarray, correction_sd: np.ndarray, noise_px: Sequence[float]
) -> IntersectedViews:
    """Return the views of an exposure from corrected pixels (2, n, 2) of all markers."""
    sigma = np.hypot(correction_sd, np.array(noise_px)[:, None])
    outside = np.zeros(sigma.shape, dtype=bool)
    views = MatchedViews(IDS, uv, sigma, correction_sd, outside)
    return IntersectedViews(views, scene_.intersector.intersect(uv, sigma))


@dataclass(frozen=True)
class Drift:
    """A drift of a quarter of an image, or of the whole image.

    Attributes
    ----------
    fluoroscope : str
    quarter : str
        A key of QUARTERS, or WHOLE.
    size : float
        [px]
    direction : float
        Direction of the shift in the image [deg].
    ramp_s : float
        Time until the drift reaches its full size.
    """

    fluoroscope: str
    quarter: str
    size: float
    direction: float
    ramp_s: float = 0.0

    @property
    def vector(self) -> np.ndarray:
        """Return the shift (2,) at full size [px]."""
        angle = np.deg2rad(self.direction)
        return self.size * np.array([np.cos(angle), np.sin(angle)])

    def fraction(self, time_s: float) -> float:
        """Return the fraction of the full size at a time after the start [s]."""
        return min(1.0, time_s / self.ramp_s) if self.ramp_s else 1.0

    def shift(self, name: str, uv: np.ndarray, time_s: float) -> np.ndarray:
        """Return the shift (k, 2) [px] of observed pixels (k, 2) at a time after the start [s]."""
        if name != self.fluoroscope or time_s < 0:
            return np.zeros_like(uv)
        inside = np.ones(len(uv), dtype=bool)
        if self.quarter != WHOLE:
            column, row = QUARTERS[self.quarter]
            inside = ((uv[:, 0] >= SIZE / 2) == column) & ((uv[:, 1] >= SIZE / 2) == row)
        return inside[:, None] * self.vector * self.fraction(time_s)


def false_alarms(
    seed: int,
    hours: float = 0.5,
    source: str = 'exposures',
    options: DriftOptions | None = None,
    clusters: bool = True,
) -> Result:
    """Count the alarms in a stream without drift.

    Return hours, the number of transitions to WARN and ERROR, the largest ratio of the evidence to
    the WARN threshold, and the messages of the alarms.
    """
    scene_ = scene(seed, source)
    watch = scene_.watch(options, clusters)
    rng = np.random.default_rng([seed, 5])
    count = [0, 0, 0]
    level = OK
    largest = 0.0
    messages = []
    for block in blocks(scene_, rng, 0, round(hours * 3600 * RATE_HZ / FRAMES)):
        state = feed(scene_, watch, block, clusters)
        largest = max(largest, state.evidence / state.threshold_warn)
        if state.level > level:
            messages.append(state.message)
            for passed in range(level + 1, state.level + 1):
                count[passed] += 1
        level = state.level
    return {
        'seed': seed,
        'source': source,
        'hours': hours,
        'warn': count[WARN],
        'error': count[ERROR],
        'largest': largest,
        'messages': messages,
    }


def right_place(state: DriftState, quarter: str) -> bool:
    """Return whether the area of a state is the quarter or a part of it."""
    u0, v0, u1, v1 = np.array(state.area) / SIZE
    if quarter == WHOLE:
        return (u1 - u0) * (v1 - v0) >= 0.49
    column, row = QUARTERS[quarter]
    return bool(
        abs((u0 + u1) / 2 - 0.25 - 0.5 * column) < 0.2
        and abs((v0 + v1) / 2 - 0.25 - 0.5 * row) < 0.2
    )


def detection(
    scene_: Scene,
    watch: DriftWatch,
    first: int,
    drift: Drift,
    rng: np.random.Generator,
    clusters: bool = True,
    after_s: float = AFTER_S,
) -> Result:
    """Return the result of a drift: delays of WARN and ERROR [s] (inf: not found), and the report.

    Parameters
    ----------
    scene_ : Scene
    watch : DriftWatch
    first : int
        Number of the block in which the drift begins.
    drift : Drift
    rng : numpy.random.Generator
    clusters : bool
        Whether the watch is given points in space.
    after_s : float
        Time after which the drift counts as not found.
    """
    begin_s = first * FRAMES / RATE_HZ
    out: Result = {
        'fluoroscope': drift.fluoroscope,
        'quarter': drift.quarter,
        'size': drift.size,
        'direction': drift.direction,
        'warn': np.inf,
        'error': np.inf,
        'kind': '',
    }

    def shift(name: str, uv: np.ndarray, time_s: float) -> np.ndarray:
        return drift.shift(name, uv, time_s - begin_s)

    stream = blocks(scene_, rng, first, round(after_s * RATE_HZ / FRAMES), shift)
    for number, block in enumerate(stream):
        state = feed(scene_, watch, block, clusters)
        # A block is tested when the next one begins, which is the time of the alarm.
        delay = number * FRAMES / RATE_HZ
        if state.level >= WARN:
            out['warn'] = min(out['warn'], delay)
        if state.level == ERROR:
            out['error'] = min(out['error'], delay)
            # Evaluate the report at this time, or later if the drift is detected later.
            if delay >= min(WITHIN_S, after_s - 1) or drift.ramp_s:
                out.update(_reported(state, drift, delay))
                break
    return out


def _reported(state: DriftState, drift: Drift, delay: float) -> Result:
    """Evaluate the report of an alarm about a drift, delay [s] after its start."""
    along = float(drift.vector @ state.direction) * drift.fraction(delay)
    if ' or ' in state.fluoroscope:  # a downward drift in one equals an upward drift in the other
        along = abs(along)
    return {
        'kind': state.finding.kind.value,
        'named': state.fluoroscope,
        'place': right_place(state, drift.quarter),
        'source': state.source,
        'sd': state.sd,
        'since': state.since_s - delay,
        'size_error': state.size - along,
    }


def started(
    seed: int, clusters: bool = True, source: str = 'exposures'
) -> tuple[Scene, DriftWatch, np.random.Generator, int]:
    """Return scene, watch after the start-up, generator, and number of blocks of the start-up."""
    scene_ = scene(seed, source)
    watch = scene_.watch(clusters=clusters)
    rng = np.random.default_rng([seed, 6])
    learned = 60
    for block in blocks(scene_, rng, 0, learned):
        feed(scene_, watch, block, clusters)
    return scene_, watch, rng, learned


def detections(
    seed: int,
    size: float = 0.5,
    clusters: bool = True,
    source: str = 'exposures',
    quarters: Sequence[str] = tuple(QUARTERS),
    directions: int = 8,
) -> list[Result]:
    """Return results of `detection` for drifts over all quarters of both images."""
    scene_, watch, rng, learned = started(seed, clusters, source)
    out = []
    total = PERIOD_S * MOTIONS * RATE_HZ // FRAMES
    for name in scene_.names:
        for quarter in quarters:
            for k in range(directions):
                first = learned + int(rng.integers(total))  # at a random phase of the motion
                drift = Drift(name, quarter, size, 360 * k / directions)
                fresh = copy.deepcopy(watch)
                out.append(detection(scene_, fresh, first, drift, rng, clusters))
    return out


def from_the_start(seed: int, size: float = 0.5, directions: int = 8) -> list[Result]:
    """Return results for drifts present from the start, which only the calibration reveals."""
    scene_ = scene(seed)
    rng = np.random.default_rng([seed, 8])
    out = []
    for name in scene_.names:
        for quarter in QUARTERS:
            for k in range(directions):
                drift = Drift(name, quarter, size, 360 * k / directions)
                first = int(rng.integers(700))
                out.append(detection(scene_, scene_.watch(), first, drift, rng))
    return out


def slow(seed: int, size: float = 0.5, hours: float = 1.0) -> list[Result]:
    """Return the result for a drift that grows for hours, in a random quarter and direction."""
    scene_, watch, rng, learned = started(seed)
    quarter = str(rng.choice(list(QUARTERS)))
    direction = 45 * int(rng.integers(8))
    name = str(rng.choice(scene_.names))
    drift = Drift(name, quarter, size, direction, hours * 3600)
    return [detection(scene_, watch, learned, drift, rng, after_s=1.1 * hours * 3600)]


# Title of a row, function, and its arguments except the seed.
CASES: tuple[tuple[str, Callable[..., list[Result]], dict[str, Any]], ...] = (
    ('0.5 px, with clusters', detections, {}),
    ('0.5 px, orientation from one capture', detections, {'source': 'capture'}),
    ('0.5 px, without clusters', detections, {'clusters': False}),
    ('0.25 px, with clusters', detections, {'size': 0.25}),
    ('1 px, with clusters', detections, {'size': 1.0}),
    ('3 px, with clusters', detections, {'size': 3.0}),
    ('0.5 px over the whole image', detections, {'quarters': (WHOLE,)}),
    ('0.5 px, there before the start', from_the_start, {}),
    ('0.5 px in an hour', slow, {}),
)
SECTORS = {
    'across': (90, 270),
    'oblique': (45, 135, 225, 315),
    'along': (0, 180),
}  # to the epipolar lines, in degrees
HEADER = [
    'drift',
    'direction',
    'drifts',
    'ERROR in 5 s',
    'WARN in 5 s',
    'found',
    'median delay [s]',
    '95 % [s]',
    'size error, RMS [px]',
    'over its sd',
    'right image',
    'either',
    'right place',
]


def row(title: str, sector: str, found: Sequence[Result]) -> list[str]:
    """Return a row of the table of detections from results of `detection`."""
    delay = np.array([f['error'] for f in found])
    reported = [f for f in found if 'named' in f]
    error = np.array([f['size_error'] for f in reported])
    normalised = error / np.array([f['sd'] for f in reported])

    def part(values: Sequence[bool] | np.ndarray) -> str:
        return f'{100 * np.mean(values):.0f} %' if len(values) else '-'

    def figure(value: float) -> str:
        return f'{value:.2f}' if np.isfinite(value) else '-'

    return [
        title,
        sector,
        str(len(found)),
        part(delay <= WITHIN_S),
        part([f['warn'] <= WITHIN_S for f in found]),
        part(np.isfinite(delay)),
        figure(np.quantile(delay, 0.5, method='higher')),
        figure(np.quantile(delay, 0.95, method='higher')),
        figure(np.sqrt(np.mean(error**2)) if len(reported) else np.nan),
        figure(np.sqrt(np.mean(normalised**2)) if len(reported) else np.nan),
        part([f['named'] == f['fluoroscope'] for f in reported]),
        part([' or ' in f['named'] and f['fluoroscope'] in f['named'] for f in reported]),
        part([f['place'] for f in reported]),
    ]


def _call(task: tuple[Callable[..., Any], dict[str, Any]]) -> Any:
    function, arguments = task
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter('error')
        return function(**arguments)


def measure(
    rigs: int = 3,
    alarm_rigs: int = 10,
    hours: float = 0.5,
    processes: int = 1,
    chosen: Sequence[str] | None = None,
) -> Result:
    """Return all results: {'alarms': dicts of false_alarms, 'cases': {title: dicts of detection}}.

    rigs: number for each case of drifts; alarm_rigs: number without drift, of hours [h] each, each
    third with the orientation of a capture; chosen: titles of cases, None for all.
    """
    tasks: list[tuple[str, Callable[..., Any], dict[str, Any]]] = [
        (
            'alarms',
            false_alarms,
            {'seed': s, 'hours': hours, 'source': 'capture' if s % 3 == 2 else 'exposures'},
        )
        for s in range(alarm_rigs)
    ]
    tasks += [
        (title, function, {'seed': 100 + s, **more})
        for title, function, more in CASES
        for s in range(rigs)
        if chosen is None or title in chosen
    ]
    with multiprocessing.get_context('spawn').Pool(processes) as pool:
        results = []
        for n, result in enumerate(pool.imap(_call, [(f, a) for _, f, a in tasks])):
            results.append(result)
            print(f'{n + 1} of {len(tasks)}: {tasks[n][0]}', file=sys.stderr, flush=True)
    cases: dict[str, list[Result]] = {}
    for (title, *_), result in zip(tasks, results):
        if title != 'alarms':
            cases.setdefault(title, []).extend(result)
    return {'alarms': [r for t, r in zip(tasks, results) if t[0] == 'alarms'], 'cases': cases}


def report(figures: Result) -> str:
    """Return the results of `measure` as text."""
    options = DriftOptions()
    alarms = figures['alarms']
    hours = sum(a['hours'] for a in alarms)
    lines = []
    if alarms:
        lines += [
            f'{hours:g} h of stream without drift on {len(alarms)} rigs, 120 Hz, 30 markers: '
            f'{sum(a["error"] for a in alarms)} false ERRORs (stated: '
            f'{hours / options.error_interval_h:.2g} at most on average), '
            f'{sum(a["warn"] for a in alarms)} false WARNs (stated: '
            f'{hours / options.warn_interval_h:.2g}); largest evidence '
            f'{max(a["largest"] for a in alarms):.2f} of the threshold of WARN.'
        ]
        lines += [text for a in alarms for text in a['messages']]
    rows = []
    for title, found in figures['cases'].items():
        for sector, degrees in SECTORS.items():
            own = [f for f in found if f['direction'] in degrees]
            rows += [row(title, sector, own)] if own else []
    return '\n'.join(lines) + '\n\n' + table(HEADER, rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog='python -m benchmarks.drift', description=__doc__.splitlines()[0]
    )
    parser.add_argument('--rigs', type=int, default=3, help='of each case of drifts (3)')
    parser.add_argument('--alarm-rigs', type=int, default=10, help='rigs without drift (10)')
    parser.add_argument('--hours', type=float, default=0.5, help='of stream of each of them (0.5)')
    parser.add_argument('--processes', type=int, default=1)
    parser.add_argument(
        '--case', action='append', help='only these cases of drifts, by their titles'
    )
    a = parser.parse_args(arguments)
    print(report(measure(a.rigs, a.alarm_rigs, a.hours, a.processes, a.case)))


if __name__ == '__main__':
    main()
