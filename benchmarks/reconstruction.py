# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Accuracy of points in space: `python -m benchmarks.reconstruction`.

Virtual rigs with image noise of 0.25 px. Each is calibrated with 15 exposures; then the phantom
stands in the rig frame for the orientation, and markers in four rigid clusters move. Aims: RMSE of
the markers within 5 % of that with perfectly known distortion; distances in the rigid clusters as
constant as their predicted standard deviations; normalised squared errors of the points with a
mean of 0.9 to 1.1.
"""

from __future__ import annotations

import argparse
import sys
import timeit
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.estimation.rig_orientation import (
    orientation_and_scatter,
    orientation_of_capture,
)
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.reconstruction.intersection import Intersector
from fluoro_calib_ros.reconstruction.reconstruct import ReconstructedFrame, RigRecording
from fluoro_calib_ros.simulation.rig import (
    Detection,
    VirtualRig,
    detect_beads,
    simulate_exposures,
    simulate_tracking,
    virtual_rig,
)

EXPOSURES = 15
NOISE_PX = 0.25
CAPTURED = 1
CLUSTERS = np.arange(24).reshape(4, 6)  # marker rows of each rigid cluster
# Margin around undistorted images: without its distortion, a point at the edge may leave the
# image.
MARGIN_PX = 100
WAYS = {
    'uncorrected': 'none',
    'knn': 'knn',
    'auto': 'auto',
    'known distortion': 'none',
}  # correction model of each
FROM_EXPOSURES = ', orientation from the calibration'


@dataclass(frozen=True)
class Outcome:
    """Results of one method on one rig.

    Attributes
    ----------
    rmse_mm : float
        3-D RMSE of the markers.
    normalised : float
        Mean normalised squared error; NaN if the rig frame differs from the true one.
    epipolar : float
        Mean squared standardised epipolar distance.
    lost : float
        Fraction of the points without coordinates.
    constancy : ndarray
        (4,), standard deviation over time of the distances in each cluster, relative to the
        predicted one.
    distance_mm : float
        RMSE of these distances.
    sd_orientation_mm : float
        3-D, of the points, due to the orientation of the rig; NaN like `normalised`.
    """

    rmse_mm: float
    normalised: float
    epipolar: float
    lost: float
    constancy: np.ndarray
    distance_mm: float
    sd_orientation_mm: float


def capture(rig: VirtualRig, seed: int, count: int = CAPTURED) -> dict[str, list[Frame]]:
    """Return {fluoroscope: [Frame, ...]} with count frames of the phantom in the rig frame."""
    rng = np.random.default_rng([seed, 4])
    return {
        f.name: [
            Frame(
                f.name,
                k + 1,
                *detect_beads(rng, f, rig.true_mm, rig.phantom.target_id, Detection(NOISE_PX)),
                f.image_size,
            )
            for k in range(count)
        ]
        for f in rig.fluoroscopes
    }


def undistorted(rig: VirtualRig, frames: Mapping[str, Sequence[Frame]]) -> dict[str, list[Frame]]:
    """Remove the true distortion from frames, and add a margin to the images."""
    field = {f.name: f.distortion for f in rig.fluoroscopes}
    return {
        name: [
            replace(
                frame,
                uv=frame.uv - field[name](frame.uv) + MARGIN_PX,
                image_size=(
                    frame.image_size[0] + 2 * MARGIN_PX,
                    frame.image_size[1] + 2 * MARGIN_PX,
                ),
            )
            for frame in of_one
        ]
        for name, of_one in frames.items()
    }


def measure(
    seed: int,
    ways: Sequence[str] = tuple(WAYS),
    seconds: float = 4.0,
    rate_hz: float = 60.0,
    captured: int = CAPTURED,
) -> dict[str, Outcome]:
    """Return the outcomes of a virtual rig, by method.

    Each method is also evaluated with the orientation from the exposures of the calibration.
    """
    rig = virtual_rig(seed)
    out = {}
    exposures = simulate_exposures(rig, EXPOSURES, seed, Detection(NOISE_PX)).frames
    standing = capture(rig, seed, captured)
    tracking = simulate_tracking(rig, seconds, rate_hz, seed, NOISE_PX)
    for way in ways:
        training = exposures
        still = standing
        moving = tracking.frames
        if way == 'known distortion':
            training, still, moving = (
                undistorted(rig, frames) for frames in (training, still, moving)
            )
        calibrations = calibrate(training, rig.phantom, CalibrationOptions(WAYS[way])).calibrations
        for label, orientation in (
            (way, orientation_of_capture(still, rig.phantom, calibrations)),
            (
                way + FROM_EXPOSURES,
                orientation_and_scatter(training, rig.phantom, calibrations)[0],
            ),
        ):
            found = RigRecording(moving, calibrations, Intersector(orientation)).reconstruct()
            out[label] = _outcome(found, tracking.points_mm, orientation.source == 'capture')
    return out


def _outcome(
    found: Sequence[ReconstructedFrame], truth: np.ndarray, in_rig_frame: bool
) -> Outcome:
    """Compare ReconstructedFrames with the true points (frames, n, 3) [mm]."""
    xyz, covariance, noise, standardised = (
        np.array([getattr(frame.points, name) for frame in found])
        for name in ('xyz_mm', 'covariance', 'covariance_noise', 'standardised')
    )
    good = np.isfinite(xyz).all(axis=2)
    normalised = np.nan
    of_rig = np.nan
    if in_rig_frame:
        error = xyz - truth
        normalised = float(
            np.mean(
                np.einsum(
                    'ni,nij,nj->n', error[good], np.linalg.inv(covariance[good]), error[good]
                )
            )
            / 3
        )
        of_rig = float(
            np.sqrt(np.mean(np.trace(covariance[good] - noise[good], axis1=1, axis2=2)))
        )
    else:
        error = np.full(xyz.shape, np.nan)
        error[good] = _fitted(xyz[good], truth[good]) - truth[good]
    constancy, off = zip(
        *(_distances(xyz[:, rows], truth[:, rows], noise[:, rows]) for rows in CLUSTERS)
    )
    return Outcome(
        float(np.sqrt(np.mean(np.sum(error[good] ** 2, axis=1)))),
        normalised,
        float(np.mean(standardised[good] ** 2)),
        float(np.mean(~good)),
        np.array(constancy),
        float(np.sqrt(np.mean(np.square(off)))),
        of_rig,
    )


def _fitted(points: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Fit points (n, 3) to the truth by a rigid motion (Kabsch 1976), if rig frames differ."""
    a = points.mean(axis=0)
    b = truth.mean(axis=0)
    left, _, right = np.linalg.svd((points - a).T @ (truth - b))
    turn = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    return (points - a) @ turn + b


def _distances(xyz: np.ndarray, truth: np.ndarray, noise: np.ndarray) -> tuple[float, float]:
    """Return constancy and RMSE [mm] of the distances in a rigid cluster (frames, k, 3).

    Constancy is the standard deviation over time relative to the predicted one.
    """
    one, other = np.triu_indices(xyz.shape[1], 1)
    apart = xyz[:, one] - xyz[:, other]
    length = np.linalg.norm(apart, axis=2)
    along = apart / length[..., None]
    variance = np.einsum('tpi,tpij,tpj->tp', along, noise[:, one] + noise[:, other], along)
    observed = np.nanvar(length, axis=0, ddof=1)
    off = length - np.linalg.norm(truth[:, one] - truth[:, other], axis=2)
    return (
        float(np.sqrt(np.mean(observed) / np.nanmean(variance))),
        float(np.sqrt(np.nanmean(off**2))),
    )


def table(outcomes: Mapping[str, Sequence[Outcome]]) -> str:
    """Return a Markdown table of {method: [Outcome of every rig]}.

    Squares are averaged over the rigs; +- is the standard error.
    """
    known = {
        suffix: _rms([o.rmse_mm for o in outcomes['known distortion' + suffix]])
        for suffix in ('', FROM_EXPOSURES)
    }
    lines = [
        '| correction | RMSE, 3-D [mm] | relative to known distortion | normalised squared error '
        '| squared standardised epipolar distance | lost points [%] | '
        'RMSE of distances in clusters [mm] |',
        '| --- ' + '| ---: ' * 6 + '|',
    ]
    for way, of_rigs in outcomes.items():
        rmse = _rms([o.rmse_mm for o in of_rigs])
        normalised = np.array([o.normalised for o in of_rigs])
        said = (
            '-'
            if np.isnan(normalised).all()
            else (f'{normalised.mean():.3f} +- {normalised.std() / np.sqrt(len(normalised)):.3f}')
        )
        ratio = rmse / known[FROM_EXPOSURES if way.endswith(FROM_EXPOSURES) else '']
        lines.append(
            f'| {way} | {rmse:.4f} | {ratio:.3f} | {said} | '
            f'{np.mean([o.epipolar for o in of_rigs]):.3f} | '
            f'{100 * np.mean([o.lost for o in of_rigs]):.2f} | '
            f'{_rms([o.distance_mm for o in of_rigs]):.4f} |'
        )
    return '\n'.join(lines)


def cluster_table(outcomes: Mapping[str, Sequence[Outcome]]) -> str:
    """Return a Markdown table of the constancy of the distances, by cluster."""
    lines = [
        '| correction | '
        + ' | '.join(f'cluster {k + 1}' for k in range(len(CLUSTERS)))
        + ' | all | maximum of a rig |',
        '| --- ' + '| ---: ' * (len(CLUSTERS) + 2) + '|',
    ]
    for way, of_rigs in outcomes.items():
        values = np.array([o.constancy for o in of_rigs])
        lines.append(
            f'| {way} | '
            + ' | '.join(f'{_rms(column):.3f}' for column in values.T)
            + f' | {_rms(values):.3f} | {values.max():.3f} |'
        )
    return '\n'.join(lines)


def _rms(values: ArrayLike) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def speed(points: int = 30, repeats: int = 2000) -> float:
    """Return the time [s] to intersect points of two views, the minimum of ten means."""
    rig = virtual_rig(1)
    calibrations = calibrate(
        simulate_exposures(rig, 5, 1).frames, rig.phantom, CalibrationOptions('parametric')
    ).calibrations
    intersector = Intersector(orientation_of_capture(capture(rig, 1), rig.phantom, calibrations))
    rng = np.random.default_rng(1)
    xyz = rng.uniform(-80, 80, (points, 3))
    uv = np.array([f.ideal(xyz) for f in rig.fluoroscopes]) + rng.normal(
        0, NOISE_PX, (2, points, 2)
    )
    sigma = np.full((2, points), NOISE_PX)
    number = repeats // 10
    return (
        min(timeit.repeat(lambda: intersector.intersect(uv, sigma), number=number, repeat=10))
        / number
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point: print the tables."""
    parser = argparse.ArgumentParser(
        prog='python -m benchmarks.reconstruction', description=__doc__
    )
    parser.add_argument('--count', type=int, default=5, help='number of virtual rigs (default: 5)')
    parser.add_argument('--first', type=int, default=1, help='seed of the first rig (default: 1)')
    parser.add_argument(
        '--captured',
        type=int,
        default=CAPTURED,
        help=f'frames of the standing phantom for the orientation (default: {CAPTURED})',
    )
    options = parser.parse_args(arguments)
    outcomes: dict[str, list[Outcome]] = {}
    for seed in range(options.first, options.first + options.count):
        for way, outcome in measure(seed, captured=options.captured).items():
            outcomes.setdefault(way, []).append(outcome)
        print(f'rig {seed}', file=sys.stderr, flush=True)
    print(
        f'{options.count} virtual rigs, {EXPOSURES} exposures, noise {NOISE_PX} px, orientation '
        f'from {options.captured} frame(s) of the standing phantom\n\n{table(outcomes)}\n'
    )
    print(
        'Standard deviation over time of the distances in rigid clusters, observed over '
        'predicted\n'
    )
    print(f'{cluster_table(outcomes)}\n')
    print(
        f'Intersection of 30 points in two views with covariance: {1e6 * speed():.0f} microseconds'
    )


if __name__ == '__main__':
    main()
