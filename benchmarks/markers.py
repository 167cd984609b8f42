# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Following markers in two or more views: ids, precision and speed.

    python -m benchmarks.markers --frames 200           all settings, as the table of
                                                        docs/how_good.md
    python -m benchmarks.markers --frames 100 --sets usual --views 3    the same in three views
    python -m benchmarks.markers --start 3              ids by shapes alone, in 3 rigs of each set
    python -m benchmarks.markers --speed                seconds of a core, and where they go
    python -m benchmarks.markers --picture PATH         an image with its overlay

30 markers in five bones, 1024 x 1024 px, views with distortion, calibrated from simulated
exposures of a phantom with noise. Settings of renderer and motion are drawn for every sequence.
The Cramer-Rao bound is that of the rendered light: its derivatives with respect to the position of
a marker, relative to the photon variance, with unknown depth of the shadow and a background of
degree 2, for isolated markers.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.distance import cdist, pdist
from threadpoolctl import threadpool_limits

from fluoro_calib_ros.api import calibrate
from fluoro_calib_ros.bodies.body import Body, declared_bodies
from fluoro_calib_ros.correction.fluoroscope_calibration import FluoroscopeCalibration
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.images.marker_decisions import revise
from fluoro_calib_ros.images.marker_ids import identify_markers
from fluoro_calib_ros.images.marker_views import MarkerViews
from fluoro_calib_ros.images.markers import (
    MIN_MEMBERS,
    FirstMarkers,
    MarkerFrame,
    MarkerOptions,
    MarkerTracker,
)
from fluoro_calib_ros.images.overlay import draw_markers
from fluoro_calib_ros.jobs.followers import MarkerSettings
from fluoro_calib_ros.photogrammetry.rig_orientation import RigOrientation
from fluoro_calib_ros.reconstruction.intersection import OUTSIDE, Intersector
from fluoro_calib_ros.reconstruction.reconstruct import ReconstructedFrame, reconstruct_exposure
from fluoro_calib_ros.simulation.marker_images import (
    HARD_MARKER_SETTINGS,
    MARKER_SETTINGS,
    MarkerImage,
    MarkerRadiography,
    MarkerScene,
    MarkerSequence,
    MovingMarkers,
)
from fluoro_calib_ros.simulation.radiographs import RadiographSettings, detected
from fluoro_calib_ros.simulation.rig import (
    BETWEEN_DEG,
    BETWEEN_THREE_DEG,
    VirtualRig,
    simulate_exposures,
    virtual_rig,
)

FIRST_RIG = 2000  # smaller seeds are used in development and tests
FRAMES_OF_A_SEQUENCE = 250
FALSE_PX = 1.5
ALONE_PX = 14.0
BOUND_EVERY = 50
BOUND_REACH = 7
STEP_MM = 0.05
SEED = 100
START_EVERY = 20  # interval of exposures at which the search for bodies starts
START_HZ = 30.0  # rate of START_EXPOSURES exposures
START_EXPOSURES = 30
START_S = 0.5
SHAPE_SD_MM = 0.05
GIVEN_SD_PX = 0.5  # standard deviation of the given positions in the first frame

SETS = ('plain', 'usual', 'fast', 'hard')


def settings_of(rng: np.random.Generator, kind: str) -> tuple[MarkerScene, RadiographSettings]:
    """Draw random scene and settings of a sequence."""
    hard = kind == 'hard'
    settings = replace(
        HARD_MARKER_SETTINGS if hard else MARKER_SETTINGS,
        blur_px=rng.uniform(0.6, 1.1),
        glare=rng.uniform(0.03, 0.2),
        focal_spot_mm=rng.uniform(0.3, 0.8),
        round_field=bool(rng.random() < 0.6),
        inverted=bool(rng.random() < 0.3),
    )
    scene = MarkerScene(
        speed_mm={'plain': 0.3, 'fast': 2.5}.get(kind, 1.0) * rng.uniform(0.8, 1.2),
        hidden=0.0 if kind == 'plain' else 0.05,
        bones=kind != 'plain',
        attenuation=rng.uniform(5.0, 9.0),
        shutter=rng.uniform(0.2, 0.5),
    )
    return scene, settings


@dataclass
class Record:
    """Counts and measurements."""

    frames: int = 0
    seen: int = 0
    measured: int = 0
    doubtful: int = 0
    wrong: int = 0
    unsaid: int = 0
    wrong_frames: int = 0
    met: int = 0
    error: list[np.ndarray] = field(default_factory=list)
    sigma: list[np.ndarray] = field(default_factory=list)
    free: list[np.ndarray] = field(default_factory=list)
    bound: list[np.ndarray] = field(default_factory=list)
    points: int = 0  # markers seen in two or more views
    intersected: int = 0
    distance: list[np.ndarray] = field(default_factory=list)
    residual: list[np.ndarray] = field(default_factory=list)

    def add(self, found: MarkerFrame, ids: np.ndarray, image: MarkerImage) -> None:
        """Compare the markers of an image with the truth."""
        row = np.searchsorted(ids, found.target_id)
        away = found.uv - image.uv[row]
        wrong = np.linalg.norm(away, axis=1) > FALSE_PX
        apart = cdist(image.uv, image.uv)
        np.fill_diagonal(apart, np.inf)
        alone = apart.min(axis=1) > ALONE_PX
        self.frames += 1
        self.seen += int(image.seen.sum())
        self.measured += int(image.seen[row].sum())
        self.doubtful += int(found.doubtful.sum())
        self.wrong += int(wrong.sum())
        self.unsaid += int((wrong & ~found.doubtful).sum())
        self.wrong_frames += bool((wrong & ~found.doubtful).any())
        self.met += int((apart.min(axis=1) < 4).sum())
        self.error.append(away[~wrong])
        self.sigma.append(found.sigma[~wrong])
        self.free.append((alone & image.seen)[row][~wrong])

    def add_points(
        self, found: ReconstructedFrame, seen: np.ndarray, markers: MovingMarkers
    ) -> None:
        """Compare distances between the points of a body with the truth.

        seen (n,): number of views that see each marker.
        """
        good = found.points.status <= OUTSIDE
        self.points += int(np.count_nonzero(seen >= 2))
        self.intersected += int(np.count_nonzero(good))
        self.residual.append(found.points.residual[good])
        rows = np.searchsorted(markers.target_id, found.target_id[good])
        for cluster in np.unique(markers.cluster):
            own = markers.cluster[rows] == cluster
            if np.count_nonzero(own) > 1:
                true = pdist(markers.local_mm[rows[own]])
                self.distance.append(pdist(found.points.xyz_mm[good][own]) - true)

    def in_space(self) -> str:
        """Return the results for points in space as text."""
        distance = np.concatenate(self.distance)
        residual = np.concatenate(self.residual)
        return (
            f'points of {self.points}: {self.intersected / self.points:.2%}, distances of markers '
            f'of a body RMSE {np.sqrt(np.mean(distance**2)):.4f} mm, by the median '
            f'{np.median(np.abs(distance)) / 0.6745:.4f} mm, residual (RMS) '
            f'{np.sqrt(np.mean(residual**2)):.3f} px'
        )

    def line(self, kind: str) -> str:
        """Return a row of the table."""
        error = np.concatenate(self.error)
        sigma = np.concatenate(self.sigma)
        free = np.concatenate(self.free)
        rmse = float(np.sqrt(np.mean(error[free] ** 2)))
        scatter = float(np.median(np.abs(error[free]))) / 0.6745
        normalised = float(np.median(np.abs(error / sigma[:, None])[free])) / 0.6745
        spread = float(np.sqrt(np.mean((error / sigma[:, None])[free] ** 2)))
        together = float(np.median(np.abs(error / sigma[:, None])[~free])) / 0.6745
        bound = float(np.sqrt(np.mean(np.concatenate(self.bound) ** 2))) if self.bound else np.nan
        return (
            f'{kind}: images {self.frames}, markers {self.seen}, within 4 px of another '
            f'{self.met / self.seen:.1%}, measured {self.measured / self.seen:.2%}, doubtful '
            f'{self.doubtful / self.seen:.2%}, wrong {self.wrong}, of them unsaid {self.unsaid} '
            f'(in {self.wrong_frames} images), RMSE {rmse:.4f}, by the median {scatter:.4f}, '
            f'bound {bound:.4f}, normalised {normalised:.2f} (RMS {spread:.2f}), not free '
            f'{together:.2f}, bias {error[free].mean(axis=0).round(4).tolist()}'
        )


def expected_light(
    radiography: MarkerRadiography,
    frame: int,
    rows: np.ndarray,
    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> np.ndarray:
    """Return the expected light (h, w) of shifted markers in rows (k,), 1 in the open beam."""
    light, _, _ = radiography._light(frame, rows, shift_mm)
    return detected(light, radiography.settings)


def bounds(radiography: MarkerRadiography, frame: int, true: np.ndarray) -> np.ndarray:
    """Return Cramer-Rao bounds (n,) [px] of markers at true (n, 2), NaN unless isolated."""
    every = np.arange(len(true))
    fluoroscope = radiography.fluoroscope
    light = expected_light(radiography, frame, every)
    without = expected_light(radiography, frame, every[:0])
    slopes = []
    still = (np.eye(3), np.zeros(3))
    points = radiography.markers.points_mm(frame)
    for axis in fluoroscope.rotation[:2]:
        step = STEP_MM * axis
        ahead = expected_light(radiography, frame, every, tuple(step))
        behind = expected_light(radiography, frame, every, tuple(-step))
        moved = radiography.centres(points + step, still) - radiography.centres(
            points - step, still
        )
        slopes.append((ahead - behind, moved))
    reach = np.arange(-BOUND_REACH, BOUND_REACH + 1)
    x, y = (part.ravel() / BOUND_REACH for part in np.meshgrid(reach, reach))
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    apart = cdist(true, true)
    np.fill_diagonal(apart, np.inf)
    out = np.full(len(true), np.nan)
    for number in np.flatnonzero(apart.min(axis=1) > ALONE_PX):
        u, v = np.rint(true[number]).astype(int)
        part = np.s_[v - BOUND_REACH : v + BOUND_REACH + 1, u - BOUND_REACH : u + BOUND_REACH + 1]
        if light[part].shape != (len(reach),) * 2:
            continue
        here = light[part].ravel()
        by_axis = np.stack([slope[part].ravel() for slope, _ in slopes])
        moved = np.stack([moved[number] for _, moved in slopes])
        by_place = np.linalg.solve(moved, by_axis)
        rows = np.concatenate([by_place, [here - without[part].ravel()], basis * here])
        weight = radiography.settings.photons / np.maximum(here, 1e-6)
        covariance = np.linalg.inv((rows * weight) @ rows.T)
        out[number] = np.sqrt(0.5 * (covariance[0, 0] + covariance[1, 1]))
    return out


def bounds_of(radiography: MarkerRadiography, truth: list[MarkerImage]) -> list[np.ndarray]:
    """Return Cramer-Rao bounds of visible markers in some of the exposures of a view."""
    out = []
    for exposure in range(BOUND_EVERY, len(truth) + 1, BOUND_EVERY):
        image = truth[exposure - 1]
        found = bounds(radiography, exposure, image.uv)
        out.append(found[np.isfinite(found) & image.seen])
    return out


def calibrated(
    seed: int, names: str = 'ab'
) -> tuple[VirtualRig, Mapping[str, FluoroscopeCalibration], RigOrientation]:
    """Return a rig and its joint calibration from 15 simulated exposures of each fluoroscope."""
    between = BETWEEN_DEG if len(names) == 2 else BETWEEN_THREE_DEG
    rig = virtual_rig(seed, names=names, between_deg=between)
    outcome = calibrate(simulate_exposures(rig, 15, seed).frames, rig.phantom, joint=True)
    assert outcome.orientation is not None
    return rig, outcome.calibrations, outcome.orientation


def first_markers(rng: np.random.Generator, ids: np.ndarray, image: MarkerImage) -> FirstMarkers:
    """Return the markers of the first image, with errors in their positions."""
    uv = image.uv[image.seen]
    return FirstMarkers(ids[image.seen], uv + rng.normal(0, GIVEN_SD_PX, uv.shape))


def follow(
    kind: str, number: int, frames: int, names: str = 'ab', start: bool = False
) -> tuple[Record, Record]:
    """Follow a sequence; return the records of live results, and of those after later decisions.

    start: whether the shapes of the bodies give the ids; otherwise, initial positions are given.
    """
    rng = np.random.default_rng([SEED, number, SETS.index(kind)])
    scene, settings = settings_of(rng, kind)
    seed = FIRST_RIG + 10 * number + SETS.index(kind)
    rig, calibrations, orientation = calibrated(seed, names)
    markers = MovingMarkers(scene, SEED + 10 * number + SETS.index(kind))
    sequence = MarkerSequence(rig, markers, settings, frames, SEED + number)
    ids = markers.target_id
    bodies = declared_bodies(
        f'bone {cluster}: {" ".join(map(str, ids[markers.cluster == cluster]))}'
        for cluster in range(scene.clusters)
    )
    options = MarkerOptions(shutter=scene.shutter)
    live = Record()
    final = Record()
    views: dict[str, list[MarkerFrame]] = {name: [] for name in names}
    truth: dict[str, list[MarkerImage]] = {name: [] for name in names}
    follower: MarkerViews | None = None
    with threadpool_limits(1):
        for exposure, images in enumerate(sequence, 1):
            if follower is None:
                first = {name: first_markers(rng, ids, image) for name, image in images.items()}
                if start:
                    bodies = known_bodies(markers)
                    shown = {name: image.image for name, image in images.items()}
                    first = identify_markers(shown, calibrations, orientation, bodies)
                follower = MarkerViews(
                    calibrations,
                    orientation,
                    options,
                    first={name: first.get(name) for name in names},
                    bodies=bodies,
                )
            found = follower.update({n: image.image for n, image in images.items()}, exposure)
            for name, image in images.items():
                views[name].append(found.views[name])
                truth[name].append(replace(image, image=np.zeros(0)))
                live.add(found.views[name], ids, image)
            for decision in found.decisions:
                of_view = views[decision.fluoroscope]
                for index in range(decision.since - 1, exposure - 1):
                    of_view[index] = revise(of_view[index], decision)
    for name in views:
        for view, image in zip(views[name], truth[name]):
            final.add(view, ids, image)
    for found_in_space, seen in zip(
        in_space(views, calibrations, orientation), zip(*truth.values()), strict=True
    ):
        count = np.sum([image.seen for image in seen], axis=0)
        final.add_points(found_in_space, count, markers)
    for fluoroscope in rig.fluoroscopes:
        radiography = MarkerRadiography(fluoroscope, markers, settings, frames, SEED + number)
        found_bounds = bounds_of(radiography, truth[fluoroscope.name])
        live.bound += found_bounds
        final.bound += found_bounds
    return live, final


def in_space(
    views: Mapping[str, list[MarkerFrame]],
    calibrations: Mapping[str, FluoroscopeCalibration],
    orientation: RigOrientation,
) -> list[ReconstructedFrame]:
    """Return the points of all exposures, excluding markers with doubtful ids."""
    intersector = Intersector(orientation)
    out = []
    for number, exposure in enumerate(zip(*views.values(), strict=True), 1):
        frames = {}
        for name, found in zip(views, exposure):
            sure = ~found.doubtful
            size = calibrations[name].image_size
            uv, sigma = found.uv[sure], found.sigma[sure]
            frames[name] = Frame(name, number, found.target_id[sure], uv, size, sigma=sigma)
        out.append(reconstruct_exposure(frames, calibrations, intersector))
    return out


def known_bodies(markers: MovingMarkers) -> tuple[Body, ...]:
    """Return bodies of known shapes."""
    out = []
    for cluster in range(markers.scene.clusters):
        own = markers.cluster == cluster
        sd = np.full(np.count_nonzero(own), SHAPE_SD_MM)
        out.append(Body(f'{cluster}', markers.target_id[own], markers.local_mm[own], sd))
    return tuple(out)


def measure_start(kind: str, rigs: int, names: str = 'ab') -> None:
    """Print how soon bodies in any pose are identified by their shapes, and the wrong ids."""
    late = []
    ids = wrong = 0
    for number in range(rigs):
        rng = np.random.default_rng([SEED, number, SETS.index(kind)])
        scene, settings = settings_of(rng, kind)
        seed = 900 + 10 * number + SETS.index(kind)
        rig, calibrations, orientation = calibrated(FIRST_RIG + seed, names)
        markers = MovingMarkers(scene, SEED + seed)
        views = {
            f.name: MarkerRadiography(f, markers, settings, FRAMES_OF_A_SEQUENCE, SEED + number)
            for f in rig.fluoroscopes
        }
        settings_of_rig = MarkerSettings(
            {}, calibrations=calibrations, orientation=orientation, bodies=known_bodies(markers)
        )
        for first in range(1, FRAMES_OF_A_SEQUENCE - START_EXPOSURES + 2, START_EVERY):
            images = (
                {name: view.take(number) for name, view in views.items()}
                for number in range(first, first + START_EXPOSURES)
            )
            with threadpool_limits(1):
                began = _started(settings_of_rig, images, markers)
            late.append(began.seconds)
            ids += began.ids
            wrong += began.wrong
            print(f'    {kind} {number}, exposure {first}: {began.seconds:.2f} s', flush=True)
    soon = np.count_nonzero(np.array(late) <= START_S)
    print(
        f'{kind}: all bodies that show {MIN_MEMBERS} markers in all views identified within '
        f'{START_S} s in {soon} of {len(late)} starts in {rigs} rigs, median '
        f'{np.median(late):.2f} s, 99 % within {np.percentile(late, 99):.2f} s; '
        f'{wrong} of {ids} ids wrong',
        flush=True,
    )


@dataclass(frozen=True)
class _Started:
    """Seconds from the first exposure to identification, ids by then, and wrong ids."""

    seconds: float
    ids: int
    wrong: int


def _started(
    settings: MarkerSettings,
    exposures: Iterable[Mapping[str, MarkerImage]],
    markers: MovingMarkers,
) -> _Started:
    """Follow exposures at START_HZ until their bodies are identified."""
    follower = settings()
    clock_s = 0.0
    ids = wrong = 0
    for number, images in enumerate(exposures):
        began = time.perf_counter()
        found = follower.extract({name: one.image for name, one in images.items()}, number + 1)
        clock_s = max(clock_s, number / START_HZ) + time.perf_counter() - began
        places = [found[name] for name in images]
        ids = sum(len(of_view.target_id) for of_view in places)
        wrong = 0
        for of_view, image in zip(places, images.values()):
            row = np.searchsorted(markers.target_id, of_view.target_id)
            away = np.linalg.norm(of_view.uv - image.uv[row], axis=1)
            wrong += int(np.count_nonzero(away > 2 * FALSE_PX))
        visible = np.logical_and.reduce([image.seen for image in images.values()])
        wanted = [
            body.target_id
            for body in settings.bodies
            if np.isin(body.target_id, markers.target_id[visible]).sum() >= MIN_MEMBERS
        ]
        if all(np.isin(of_view.target_id, one).any() for one in wanted for of_view in places):
            return _Started(clock_s, ids, wrong)
    return _Started(np.inf, ids, wrong)


def joined(records: list[Record]) -> Record:
    """Return the sum of records."""
    out = Record()
    for record in records:
        for name, value in vars(record).items():
            setattr(out, name, getattr(out, name) + value)
    return out


def measure_speed(frames: int = 80) -> None:
    """Print the time that an image takes on one core, and how it is spent."""
    rig = virtual_rig(FIRST_RIG)
    markers = MovingMarkers(MarkerScene(), SEED)
    radiography = MarkerRadiography(rig.fluoroscopes[0], markers, MARKER_SETTINGS, frames, SEED)
    images = [radiography.take(frame) for frame in range(1, frames + 1)]
    rng = np.random.default_rng(SEED)
    first = first_markers(rng, markers.target_id, images[0])
    options = MarkerOptions(shutter=markers.scene.shutter)
    with threadpool_limits(1):
        for profiled in (False, True):
            tracker = MarkerTracker(options, first=first)
            profile = cProfile.Profile()
            times = []
            for frame, image in enumerate(images, 1):
                if profiled and frame == 2:
                    profile.enable()
                began = time.process_time()
                tracker.update(image.image, frame)
                times.append(time.process_time() - began)
            profile.disable()
            if not profiled:
                later = np.array(times[1:]) * 1e3
                print(
                    f'{len(first.target_id)} markers: first image {times[0] * 1e3:.0f} ms, others '
                    f'{np.median(later):.1f} ms of a core (95 %: {np.percentile(later, 95):.1f})'
                )
    pstats.Stats(profile).sort_stats('cumulative').print_stats(25)


def draw(path: Path) -> None:
    """Write an image with its overlay."""
    rig = virtual_rig(FIRST_RIG)
    markers = MovingMarkers(MarkerScene(), SEED + 1)
    radiography = MarkerRadiography(rig.fluoroscopes[0], markers, HARD_MARKER_SETTINGS, 60, SEED)
    tracker: MarkerTracker | None = None
    for frame in range(1, 41):
        image = radiography.take(frame)
        if tracker is None:
            first = FirstMarkers(markers.target_id[image.seen], image.uv[image.seen])
            tracker = MarkerTracker(MarkerOptions(shutter=0.4), first=first)
        found = tracker.update(image.image, frame)
    low = np.maximum(image.uv.min(axis=0).astype(int) - 25, 0)
    high = image.uv.max(axis=0).astype(int) + 40
    part = np.s_[low[1] : high[1], low[0] : high[0]]
    picture = draw_markers(image.image, found)[part]
    plain = cv2.cvtColor(cv2.convertScaleAbs(image.image), cv2.COLOR_GRAY2BGR)[part]
    cv2.imwrite(str(path), np.hstack([plain, picture]))


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--frames', type=int, default=0, metavar='N', help='exposures of a set')
    parser.add_argument('--sets', nargs='+', default=SETS, choices=SETS)
    parser.add_argument('--views', type=int, default=2, choices=(2, 3))
    parser.add_argument('--by-shapes', action='store_true', help='first ids by bodies, not given')
    parser.add_argument('--start', type=int, default=0, metavar='N', help='rigs of a set')
    parser.add_argument('--speed', action='store_true')
    parser.add_argument('--picture', type=Path)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    names = 'abc'[: arguments.views]
    if arguments.frames:
        for kind in arguments.sets:
            records = []
            for number, start in enumerate(range(0, arguments.frames, FRAMES_OF_A_SEQUENCE)):
                frames = min(FRAMES_OF_A_SEQUENCE, arguments.frames - start)
                records.append(follow(kind, number, frames, names, arguments.by_shapes))
                print('   ', records[-1][1].line(f'{kind} {number}'), flush=True)
            print(joined([live for live, _ in records]).line(f'{kind}, live'), flush=True)
            revised = joined([final for _, final in records])
            print(revised.line(f'{kind}, revised'), flush=True)
            print(f'{kind}, in space: {revised.in_space()}', flush=True)
    for kind in arguments.sets if arguments.start else ():
        measure_start(kind, arguments.start, names)
    if arguments.speed:
        measure_speed()
    if arguments.picture:
        draw(arguments.picture)


if __name__ == '__main__':
    main()
