# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Extraction of beads from radiographs: completeness, precision, claimed sd and false ids.

    python -m benchmarks.extraction --images 100        all sets of images, printed as tables of
                                                        docs/how_good.md
    python -m benchmarks.extraction --points 500        poses from points alone
    python -m benchmarks.extraction --calibration 12    calibration from images and true centres
    python -m benchmarks.extraction --picture PATH      an image with its overlay

The settings of the renderer (bead, blur, glare, field, polarity, distortion) are drawn anew for
every image. The images of the set `followed` are clean, and each follows one with the phantom
rotated by one degree. The Cramer-Rao bound is that of the rendered light: its derivative with
respect to the position of a bead, relative to the photon variance, for isolated beads.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.exposures.frame import Frame, points_on_image
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.images.extraction import Extraction, extract_beads
from fluoro_calib_ros.images.growth import Seen
from fluoro_calib_ros.images.matching import PhantomModel, match
from fluoro_calib_ros.images.overlay import draw_overlay
from fluoro_calib_ros.images.view import Lens
from fluoro_calib_ros.jobs.calibration import adjust, run_calibration
from fluoro_calib_ros.simulation.radiographs import CLEAN, HARD, RadiographSettings, Radiography
from fluoro_calib_ros.simulation.rig import (
    Pose,
    VirtualFluoroscope,
    VirtualRig,
    phantom_poses,
    virtual_rig,
)

FIRST_RIG = 1000  # smaller seeds are used in development and tests
IMAGES_OF_A_RIG = 5
BOUND_IMAGES = 12  # images of a set for which the bound is computed
FALSE_PX = 1.0
UNSEEN = 8  # exposures for the test of a calibration
PLAIN = 0.3  # deviation of a plain background from a polynomial, relative to the noise
SIZE = (1024, 1024)
SETS = ('clean', 'hard', 'followed')
TURN = Rotation.from_euler('z', 1, degrees=True).as_matrix()  # since the followed image
KINDS = ('turntable', 'any', 'tube', 'other')  # kinds of poses; 'other': pose of another phantom


def settings_of(rng: np.random.Generator, hard: bool) -> RadiographSettings:
    """Draw random settings of an image."""
    base = HARD if hard else CLEAN
    return replace(
        base,
        bead_mm=rng.uniform(1.6, 2.6),
        blur_px=rng.uniform(0.7, 1.2),
        glare=rng.uniform(0.1, 0.2) if hard else rng.uniform(0.03, 0.12),
        focal_spot_mm=rng.uniform(0.3, 1.0),
        round_field=rng.random() < 0.7,
        inverted=rng.random() < 0.3,
    )


def bound(
    radiography: Radiography, rig: VirtualRig, pose: Pose, seed: int, centres: np.ndarray
) -> np.ndarray:
    """Return Cramer-Rao bounds (n,) of a coordinate [px] of isolated beads at centres (n, 2).

    A bound is NaN where the background is not plain, that is, where a polynomial of degree 2 does
    not fit it within a fraction of the noise.
    """
    light = radiography.light(rig.true_mm, pose, seed)
    without = radiography.light(rig.true_mm[:0], pose, seed)
    by_v, by_u = np.gradient(light)
    variance = np.maximum(light, 1e-6) / radiography.settings.photons
    reach = 7
    out = np.full(len(centres), np.nan)
    for number, (u, v) in enumerate(np.rint(centres).astype(int)):
        part = np.s_[v - reach : v + reach + 1, u - reach : u + reach + 1]
        if min(u, v) < reach or light[part].shape != (2 * reach + 1,) * 2:
            continue
        if _roughness(without[part]) > PLAIN * np.sqrt(np.mean(variance[part])):
            continue
        # Do not count background slopes as information of the shadow.
        information = [
            np.sum((slope[part] - np.median(slope[part])) ** 2 / variance[part])
            for slope in (by_u, by_v)
        ]
        out[number] = np.sqrt(0.5 * (1 / information[0] + 1 / information[1]))
    return out


def _roughness(background: np.ndarray) -> float:
    """Return the RMS residual of a degree-2 polynomial fitted to a window (k, k)."""
    y, x = np.indices(background.shape) / len(background) - 0.5
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1).reshape(-1, 6)
    values = background.reshape(-1).astype(float)
    fitted = basis @ np.linalg.lstsq(basis, values, rcond=None)[0]
    return rms(values - fitted)


def measure_set(count: int, name: str, report: Callable[[str], None]) -> dict[str, Any]:
    """Extract beads from a set of images and compare them with the truth."""
    hard = name == 'hard'
    records: dict[str, list[Any]] = {
        key: []
        for key in ('seconds', 'error', 'sigma', 'overlapped', 'free', 'bound', 'found', 'refused')
    }
    false_of: list[float] = []
    for number in range(count):
        rng = np.random.default_rng([number, int(hard), 77])
        if number % IMAGES_OF_A_RIG == 0:
            rig = virtual_rig(FIRST_RIG + number + 500 * hard, rng.uniform(0.5, 1.2))
            model = PhantomModel.of(rig.phantom.xyz_mm)
        settings = settings_of(rng, hard)
        radiography = Radiography(rig.fluoroscopes[number % 2], settings)
        pose = phantom_poses(rng, 1)[0]
        image = radiography.image(rig.true_mm, pose, number)
        centres = radiography.centres(rig.true_mm, pose)
        shadow = settings.bead_mm * 4.4 / 3 + 2 * settings.blur_px
        alone = cKDTree(centres).query(centres, k=2)[0][:, 1] > 2 * shadow
        free = alone & radiography.in_field(centres, shadow + 4)
        free &= points_on_image(centres, SIZE)
        near = None
        if name == 'followed':
            before = radiography.image(rig.true_mm, (TURN @ pose[0], *pose[1:]), number + 50)
            near = extract_beads(before, model, Lens(SIZE, 4000.0)).nearby
        start = time.process_time()
        try:
            found = extract_beads(image, model, Lens(SIZE, 4000.0), near)
        except DataError as refusal:
            records['refused'].append(f'image {number}: {refusal}')
            records['seconds'].append(time.process_time() - start)
            records['found'].append((0, int(free.sum())))
            report(records['refused'][-1])
            continue
        records['seconds'].append(time.process_time() - start)
        error = found.uv - centres[found.bead]
        records['error'].append(error)
        records['sigma'].append(found.sigma)
        records['overlapped'].append(found.overlapped)
        records['free'].append(free[found.bead])
        records['found'].append((int(np.isin(np.flatnonzero(free), found.bead).sum()), free.sum()))
        limit = np.full(len(error), np.nan)
        if number < BOUND_IMAGES:
            limit = bound(radiography, rig, pose, number, centres[found.bead])
        records['bound'].append(limit)
        false_of.append(float(np.mean(np.abs(error).max(axis=1) > FALSE_PX)))
        report(
            f'{name} {number}: {len(error)} beads{" followed" * found.followed}, free '
            f'{records["found"][-1][0]}/{records["found"][-1][1]}, rms '
            f'{np.sqrt(np.mean(error[free[found.bead]] ** 2)):.4f} px, '
            f'{records["seconds"][-1]:.2f} s'
        )
        if number % 10 == 9:
            report(f'so far: {summary(records, false_of)}')
    return summary(records, false_of)


def summary(records: dict[str, list[Any]], false_of: list[float]) -> dict[str, Any]:
    """Return summary figures of a set."""
    error, sigma, overlapped, free, limit = (
        np.concatenate(records[key]) for key in ('error', 'sigma', 'overlapped', 'free', 'bound')
    )
    known = free & np.isfinite(limit) & ~overlapped
    found, present = np.sum(records['found'], axis=0)
    far = np.abs(error).max(axis=1) > FALSE_PX
    good = ~far
    return {
        'images': len(records['seconds']),
        'refused images': len(records['refused']),
        'observations': len(error),
        'free beads found and matched': f'{found / present:.2%}',
        'centre RMSE of free beads [px]': round(rms(error[free]), 4),
        'bias u, v [px]': tuple(np.round(error[free & good].mean(axis=0), 4).tolist()),
        'RMSE over Cramer-Rao bound, plain background': round(
            rms(error[known]) / rms(limit[known]), 3
        ),
        'the same, by medians': round(robust(error[known] / limit[known, None]), 3),
        'normalised residuals, free': round(rms(error[free] / sigma[free, None]), 3),
        'the same, median': round(robust(error[free] / sigma[free, None]), 3),
        'RMSE of overlapped beads [px]': round(rms(error[overlapped]), 4),
        'normalised residuals, overlapped': round(
            rms(error[overlapped & good] / sigma[overlapped & good, None]), 3
        ),
        'the same, median of overlapped': round(
            robust(error[overlapped] / sigma[overlapped, None]), 3
        ),
        'false matches (> 1 px)': f'{np.count_nonzero(far)} ({np.mean(far):.3%})',
        'largest share of false matches in an image': f'{max(false_of):.2%}',
        'seconds of a core, median': round(float(np.median(records['seconds'])), 2),
        'seconds of a core, largest': round(float(np.max(records['seconds'])), 2),
    }


def rms(values: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def robust(values: np.ndarray) -> float:
    """Return the standard deviation estimated from the median of absolute values."""
    return float(np.median(np.abs(values)) / 0.6745)


def pose_of(kind: str, rng: np.random.Generator, fluoroscope: VirtualFluoroscope) -> Pose:
    """Draw a pose: on the turntable, anywhere, or with the tube of the phantom along the axis."""
    if kind == 'turntable':
        return phantom_poses(rng, 1)[0]
    if kind == 'any':
        turn = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
        return turn, rng.uniform(-80, 80, 3)
    x, y, z = fluoroscope.rotation
    tilt = Rotation.from_rotvec(rng.normal(0, 0.06, 3)).as_matrix()
    about = Rotation.from_euler('z', rng.uniform(0, 2 * np.pi)).as_matrix()
    return tilt @ np.column_stack([x, y, z]) @ about, rng.uniform(-60, 60, 3)


def seen_points(rng: np.random.Generator, observed: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Return points (n, 2) as detected: close ones merged, some missing, some spurious."""
    inside = points_on_image(observed, SIZE)
    inside[inside] = field[tuple(np.rint(observed[inside]).astype(int).T[::-1])]
    uv = observed[inside] + rng.normal(0, 0.15, (inside.sum(), 2))
    gone = rng.random(len(uv)) < 0.02
    for a, b in cKDTree(uv).query_pairs(3.5):
        if not gone[a] and not gone[b]:
            uv[a] = (uv[a] + uv[b]) / 2
            gone[b] = True
    extra = rng.uniform(0, 1023, (int(rng.uniform(0, 0.2) * len(uv)), 2))
    extra = extra[field[tuple(np.rint(extra).astype(int).T[::-1])]]
    return np.concatenate([uv[~gone], extra])


def measure_points(count: int, kind: str, report: Callable[[str], None]) -> dict[str, Any]:
    """Match points of random poses; kind 'other': a phantom that is not in the image."""
    y, x = np.mgrid[:1024, :1024]
    field = np.hypot(x - 511.5, y - 511.5) < 490
    wrong = 0
    refused = []
    seconds = []
    for number in range(count):
        rng = np.random.default_rng([number, 5, len(kind)])
        if number % 10 == 0:
            rig = virtual_rig(FIRST_RIG + 2000 + number, rng.uniform(0.5, 1.2))
            other = virtual_rig(FIRST_RIG + 7000 + number) if kind == 'other' else rig
            model = PhantomModel.of(other.phantom.xyz_mm)
        fluoroscope = rig.fluoroscopes[number % 2]
        rotation, shift = pose_of('any' if kind == 'other' else kind, rng, fluoroscope)
        true = fluoroscope.distortion.distort(fluoroscope.ideal(rig.true_mm @ rotation.T + shift))
        uv = seen_points(rng, true, field)
        start = time.process_time()
        try:
            found = match(Seen.of(uv, field, 2.6), model, Lens(SIZE, 4000.0))
        except DataError as error:
            refused.append(f'{kind} {number}: {error}')
        else:
            away = np.linalg.norm(uv[found.detection] - true[found.bead], axis=1)
            if np.mean(away > 4) > 0.05 or kind == 'other':
                wrong += 1
                report(f'{kind} {number}: WRONG')
        seconds.append(time.process_time() - start)
        if number % 20 == 19:
            report(f'{kind} {number + 1}: {wrong} wrong, {len(refused)} refused')
    for sentence in refused[:5] if kind != 'other' else ():
        report(sentence)
    return {
        'poses': count,
        'wrong, accepted': wrong,
        'refused': len(refused),
        'seconds of a core, median': round(float(np.median(seconds)), 2),
        'seconds of a core, largest': round(float(np.max(seconds)), 2),
    }


def phantoms(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return beads (n, 3) [mm] of regular or nearly regular phantoms."""
    axis = np.arange(4) * 40.0 - 60
    cube = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    side = np.arange(21) * 10.0 - 100
    grid = np.stack(np.meshgrid(side, side, [0.0]), axis=-1).reshape(-1, 3)
    kept = np.sort(rng.permutation(len(grid))[25:])
    bent = grid + np.append(rng.uniform(-1.5, 1.5, (len(grid), 2)), 0 * grid[:, :1], axis=1)
    return {
        'regular cube of 64 beads': cube,
        'two regular layers of 32 beads': cube[np.abs(cube[:, 2]) < 30],
        'cube of 64 beads, displaced by up to 0.5 mm': cube + rng.uniform(-0.5, 0.5, (64, 3)),
        'cube of 64 beads, displaced by up to 6 mm': cube + rng.uniform(-6, 6, (64, 3)),
        'regular flat grid of 441 beads': grid,
        'flat grid of 416 of 441 beads': grid[kept],
        'flat grid of 441 beads, displaced by up to 1.5 mm': bent,
    }


def measure_phantoms(count: int, report: Callable[[str], None]) -> dict[str, dict[str, Any]]:
    """Match points of other phantoms: cubes from anywhere, flat grids within about 30 degrees."""
    y, x = np.mgrid[:1024, :1024]
    field = np.hypot(x - 511.5, y - 511.5) < 490
    tables: dict[str, dict[str, Any]] = {}
    for number in range(count):
        rng = np.random.default_rng([number, 6])
        fluoroscope = virtual_rig(FIRST_RIG + 3000 + number, rng.uniform(0.5, 1.2)).fluoroscopes[0]
        for name, xyz in phantoms(rng).items():
            rotation, shift = pose_of('any', rng, fluoroscope)
            if 'flat' in name:
                tilt = Rotation.from_rotvec(rng.normal(0, 0.25, 3)).as_matrix()
                turn = Rotation.from_euler('z', rng.uniform(0, 2 * np.pi)).as_matrix()
                rotation = fluoroscope.rotation.T @ tilt @ turn
            true = fluoroscope.distortion.distort(
                fluoroscope.ideal(xyz @ rotation.T + 0.25 * shift)
            )
            uv = seen_points(rng, true, field)
            table = tables.setdefault(
                name,
                {'poses': 0, 'wrong, accepted': 0, 'refused': 0, 'ambiguous': 0, 'seconds': []},
            )
            model = PhantomModel.of(xyz)
            start = time.process_time()
            try:
                found = match(Seen.of(uv, field, 2.6), model, Lens(SIZE, 4000.0))
            except DataError as error:
                table['ambiguous' if 'ambiguous' in str(error) else 'refused'] += 1
            else:
                away = np.linalg.norm(uv[found.detection] - true[found.bead], axis=1)
                table['wrong, accepted'] += bool(np.mean(away > 4) > 0.05)
            table['poses'] += 1
            table['seconds'].append(round(time.process_time() - start, 1))
        report(f'phantoms: {number + 1} of {count}')
    for table in tables.values():
        seconds = table.pop('seconds')
        table['seconds of a core, median'] = float(np.median(seconds))
        table['seconds of a core, largest'] = max(seconds)
    return tables


def measure_calibration(count: int, report: Callable[[str], None]) -> dict[str, Any]:
    """Calibrate from images and from true centres, and compare points in space and sources.

    Both calibrations are fixed in the adjustments of unseen radiographs and of the true centres of
    the same beads.
    """
    rig = virtual_rig(FIRST_RIG + 9000)
    rng = np.random.default_rng(91)
    seen = _extracted(rig, phantom_poses(rng, count), 1, report)
    unseen_poses = phantom_poses(rng, UNSEEN)
    unseen = _extracted(rig, unseen_poses, 1001, report)
    out: dict[str, Any] = {}
    for name, frames in (('from images', seen[0]), ('from true centres', seen[1])):
        options = CalibrationOptions(model='local_linear')
        outcome = run_calibration(CalibrationRequest(frames, rig.phantom, options, True))
        for test_name, test in (('images', unseen[0]), ('true centres', unseen[1])):
            errors = errors_in_space(test, outcome.calibrations, rig, unseen_poses)
            out[f'calibrated {name}, tested on {test_name}'] = errors
            report(f'calibrated {name}, tested on {test_name}: {errors}')
    return out


def _extracted(
    rig: VirtualRig, poses: list[Pose], first: int, report: Callable[[str], None]
) -> tuple[dict[str, list[Frame]], dict[str, list[Frame]]]:
    """Return frames of rendered radiographs, and the same frames with the true centres."""
    extracted: dict[str, list[Frame]] = {}
    ideal: dict[str, list[Frame]] = {}
    model = PhantomModel.of(rig.phantom.xyz_mm)
    for fluoroscope in rig.fluoroscopes:
        radiography = Radiography(fluoroscope, CLEAN)
        extracted[fluoroscope.name] = []
        ideal[fluoroscope.name] = []
        for number, pose in enumerate(poses, first):
            image = radiography.image(rig.true_mm, pose, number)
            found: Extraction = extract_beads(image, model, Lens(SIZE, 4000.0))
            ids = rig.phantom.target_id[found.bead]
            frame = Frame(fluoroscope.name, number, ids, found.uv, SIZE, found.sigma)
            extracted[fluoroscope.name].append(frame)
            centres = radiography.centres(rig.true_mm, pose)[found.bead]
            ideal[fluoroscope.name].append(replace(frame, uv=centres))
            report(f'{fluoroscope.name} {number}: {len(ids)} beads')
    return extracted, ideal


def errors_in_space(
    frames: dict[str, list[Frame]], calibrations: Any, rig: VirtualRig, poses: list[Pose]
) -> dict[str, float]:
    """Return the RMSE of object points and sources [mm], adjusted with fixed calibrations."""
    phantom = Phantom(rig.phantom.target_id, rig.phantom.xyz_mm, rig.phantom.sd_mm)
    result = adjust(frames, phantom, calibrations)
    row = rig.phantom.index(result.targets.target_id)
    sources = []
    for fluoroscope in rig.fluoroscopes:
        exposures = result.fluoroscopes[fluoroscope.name].exposures
        for exposure, (rotation, shift) in zip(exposures, poses):
            true = rotation.T @ (fluoroscope.position_mm - shift)
            sources.append(exposure.position_mm - true)
    return {
        'object points [mm]': round(rms(result.targets.xyz_mm - rig.true_mm[row]), 5),
        'sources [mm]': round(rms(np.array(sources)), 4),
    }


def write_picture(path: Path) -> None:
    """Write a part of a hard image next to the same part of its overlay."""
    rig = virtual_rig(5)
    radiography = Radiography(rig.fluoroscopes[0], HARD)
    image = radiography.image(rig.true_mm, phantom_poses(np.random.default_rng(3), 4)[1], 1)
    found = extract_beads(image, PhantomModel.of(rig.phantom.xyz_mm), Lens(SIZE, 4000.0))
    part = np.s_[200:700, 280:780]
    left = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)[part]
    picture = np.hstack([left, draw_overlay(image, found)[part]])
    cv2.imwrite(str(path), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--images', type=int, default=0, help='images of each set')
    parser.add_argument('--sets', nargs='+', default=SETS, choices=SETS)
    parser.add_argument('--points', type=int, default=0, help='poses of each kind')
    parser.add_argument('--kinds', nargs='+', default=KINDS, choices=KINDS)
    parser.add_argument('--phantoms', type=int, default=0, help='poses of each other phantom')
    parser.add_argument('--calibration', type=int, default=0, help='exposures')
    parser.add_argument('--picture', type=Path)
    arguments = parser.parse_args()
    tables: dict[str, dict[str, Any]] = {}

    def report(text: str) -> None:
        print(text, flush=True)

    if arguments.picture:
        write_picture(arguments.picture)
    if arguments.points:
        for kind in arguments.kinds:
            tables[kind] = measure_points(arguments.points, kind, report)
            report(f'{kind}: {tables[kind]}')
    if arguments.phantoms:
        tables.update(measure_phantoms(arguments.phantoms, report))
    if arguments.images:
        for name in arguments.sets:
            tables[name] = measure_set(arguments.images, name, report)
            report(f'{name}: {tables[name]}')
    if arguments.calibration:
        measure_calibration(arguments.calibration, report)
    for name, table in tables.items():
        print(f'\n| {name} | |\n| --- | --- |')
        for key, value in table.items():
            print(f'| {key} | {value} |')


if __name__ == '__main__':
    main()
