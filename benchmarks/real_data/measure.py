# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibrate with a part of the exposures of a set, and test with the others."""

from __future__ import annotations

import time
import traceback
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import cv2
import numpy as np

import fluoro_calib_ros as fc
from fluoro_calib_ros.correction.registry import CollocationModel
from fluoro_calib_ros.exposures.frame import Frame

from .claims import expected_square
from .peers import MODELS, calibrate_with_mrcal, calibrate_with_opencv
from .scoring import (
    STEP_PX,
    Camera,
    OpenCVCamera,
    calibrated_camera,
    false_matches,
    inside_hull,
    rms,
    solved,
    unseen_residuals,
)
from .sets import CAMERA, DataSet

OURS = 'this package'
MIN_TRAINING = 3


@dataclass
class Fold:
    """Results of one split.

    Attributes
    ----------
    training, tested : int
        Exposures.
    inside, outside : int
        Image points of the tested exposures inside and outside the hull of the calibrated area.
    false : int
        Image points that no camera model explains; they are not counted elsewhere.
    rms_inside, rms_outside, rms : dict of str to float
        RMS of a coordinate of the residuals [px] by camera, targets estimated.
    rms_held : dict of str to float
        The same inside, with the survey fixed.
    nse : float
        From an adjustment of the tested exposures with fixed calibration: square sum of the
        residuals inside over their claimed variance, per degree of freedom, without outliers.
    nse_thirds : list of float
        NSE of the third of these image points that is nearest to the middle of the image, of the
        next, and of the third at the rim.
    nse_correlated : float
        The same over its expectation by the covariances of the calibration (see `claims`).
    rejected : float
        Fraction of the image points inside that the adjustment classifies as gross errors.
    seconds : float
        CPU time of the calibration.
    model : str
    noise_px : float
        Claimed standard deviation of an image coordinate.
    doubts : list of str
        Reasons for refusing the input, which was then calibrated with `force`.
    warnings : list of str
    error : str
        Reason if there is no calibration.
    verdict : str
    findings : list of str
    """

    training: int
    tested: int
    inside: int = 0
    outside: int = 0
    false: int = 0
    rms_inside: dict[str, float] = field(default_factory=dict)
    rms_outside: dict[str, float] = field(default_factory=dict)
    rms: dict[str, float] = field(default_factory=dict)
    rms_held: dict[str, float] = field(default_factory=dict)
    nse: float = float('nan')
    nse_thirds: list[float] = field(default_factory=list)
    nse_correlated: float = float('nan')
    rejected: float = float('nan')
    seconds: float = float('nan')
    model: str = ''
    noise_px: float = float('nan')
    doubts: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    error: str = ''
    verdict: str = ''
    findings: list[str] = field(default_factory=list)


def splits(frames: Sequence[Frame], seed: int = 1) -> list[tuple[list[Frame], list[Frame]]]:
    """Use each of two random halves for training and for testing; train with at least three."""
    order = np.random.default_rng(seed).permutation(len(frames))
    half = max((len(frames) + 1) // 2, MIN_TRAINING)
    parts = (order[:half], order[len(frames) - half :])
    return [
        (
            [frames[i] for i in sorted(part)],
            [frames[i] for i in range(len(frames)) if i not in set(part.tolist())],
        )
        for part in parts
    ]


def _calibrated(data: DataSet, training: Sequence[Frame], fold: Fold) -> fc.CalibrationOutcome:
    """Calibrate, with `force` if the input is refused, and fill in the fold."""
    before = time.process_time()
    request = fc.CalibrationRequest(
        {CAMERA: training},
        data.phantom,
        fc.CalibrationOptions(),
        principal_distance=data.principal_distance,
    )
    try:
        outcome = fc.run_calibration(request)
    except fc.DataError as error:
        fold.doubts = [str(error)]
        before = time.process_time()
        outcome = fc.run_calibration(request, force=True)
    fold.seconds = time.process_time() - before
    return outcome


def _starts(data: DataSet, frames: Sequence[Frame], camera: OpenCVCamera) -> dict[int, np.ndarray]:
    """Return approximate poses (6,) of frames by their number."""
    out = {}
    for frame in frames:
        xyz = data.phantom.xyz_mm[data.phantom.index(frame.target_id)]
        _, rotation, shift = cv2.solvePnP(xyz, frame.uv, camera.matrix, camera.distortion)
        out[frame.number] = np.concatenate([rotation.ravel(), shift.ravel()])
    return out


def _pixels(frames: Sequence[Frame]) -> np.ndarray:
    """Return the image points and their neighbours, whose directions are needed."""
    steps = np.array([[0, 0], [STEP_PX, 0], [-STEP_PX, 0], [0, STEP_PX], [0, -STEP_PX]])
    return np.concatenate([frame.uv + step for frame in frames for step in steps])


def measure_fold(
    data: DataSet,
    training: Sequence[Frame],
    tested: Sequence[Frame],
    mrcal: str | None,
    validated: bool,
) -> Fold:
    """Calibrate with some exposures and test with others.

    mrcal: interpreter with mrcal, None to omit it. validated: whether to compute a verdict.
    """
    fold = Fold(len(training), len(tested))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always')
        try:
            outcome = _calibrated(data, training, fold)
        except fc.DataError as error:
            fold.error = str(error)
        except Exception:  # unexpected errors are reported, too
            fold.error = 'traceback: ' + traceback.format_exc().splitlines()[-1]
        else:
            _measure(data, training, tested, outcome, mrcal, fold)
            if validated:
                validation = fc.validate(outcome.request, outcome.result.calibrations)
                fold.verdict = validation.verdict
                fold.findings = list(map(str, validation.findings))
    fold.warnings = sorted({f'{w.category.__name__}: {w.message}' for w in caught})
    return fold


def _measure(
    data: DataSet,
    training: Sequence[Frame],
    tested: Sequence[Frame],
    outcome: fc.CalibrationOutcome,
    mrcal: str | None,
    fold: Fold,
) -> None:
    """Fill a fold with the residuals of all cameras."""
    calibration = outcome.calibrations[CAMERA]
    fold.model = calibration.model.kind
    fold.noise_px = calibration.image_sd
    found = {
        name: calibrate_with_opencv(training, data.phantom, calibration.interior, flags)
        for name, flags in MODELS.items()
    }
    cameras: dict[str, Camera] = {OURS: calibrated_camera(calibration)}
    cameras |= {name: camera for name, (camera, _) in found.items()}
    brown = found['OpenCV Brown']
    if mrcal:
        cameras |= calibrate_with_mrcal(mrcal, training, data.phantom, brown, _pixels(tested))
    start = _starts(data, tested, brown[0])
    by_frame = {
        name: unseen_residuals(camera, tested, data.phantom, start)
        for name, camera in cameras.items()
    }
    held = {name: parts[0] for name, parts in by_frame.items()}
    residuals = {name: parts[1] for name, parts in by_frame.items()}
    good = solved(residuals)
    wrong = false_matches({name: residuals[name] for name in good})
    uv = np.concatenate([frame.uv for frame in tested])
    inside = inside_hull(training, uv)
    fold.false = int(wrong.sum())
    fold.inside = int((inside & ~wrong).sum())
    fold.outside = int((~inside & ~wrong).sum())
    for name, r in residuals.items():
        if name not in good:
            for table in (fold.rms, fold.rms_inside, fold.rms_outside, fold.rms_held):
                table[name] = float('nan')
            continue
        fold.rms[name] = rms(r[~wrong])
        fold.rms_inside[name] = rms(r[inside & ~wrong])
        fold.rms_outside[name] = rms(r[~inside & ~wrong])
        fold.rms_held[name] = rms(held[name][inside & ~wrong])
    _test_claims(data, tested, outcome, np.stack([inside, inside & ~wrong], axis=1), fold)


def _test_claims(
    data: DataSet,
    tested: Sequence[Frame],
    outcome: fc.CalibrationOutcome,
    inside: np.ndarray,
    fold: Fold,
) -> None:
    """Fill in the results of an adjustment of the tested exposures with fixed calibration.

    inside (N, 2): whether image points, in the order of the frames, are in the hull of the
    calibrated area, and whether some camera also explains them.
    """
    adjusted = fc.adjust({CAMERA: tested}, data.phantom, outcome.calibrations)
    table = adjusted.residuals
    assert table is not None
    keys = [(f.number, i) for f in tested for i in f.target_id.tolist()]
    counts = dict(zip(keys, inside.tolist()))
    kept, explained = np.array(
        [counts[key] for key in zip(table.exposure.tolist(), table.target_id.tolist())]
    ).T
    fold.rejected = float(np.mean(table.outlier[explained]))
    # The claim includes points that no camera explains if the adjustment keeps them.
    kept &= ~table.outlier
    claimed = outcome.calibrations[CAMERA].correct(table.uv[kept], exact=True).sigma
    squares = np.sum(table.residual[kept] ** 2, axis=1) / claimed**2
    redundancy = np.sum(table.redundancy[kept], axis=1)
    fold.nse = float(np.sum(squares) / np.sum(redundancy))
    middle = (np.asarray(data.image_size) - 1) / 2
    order = np.argsort(np.linalg.norm(table.uv[kept] - middle, axis=1))
    fold.nse_thirds = [
        float(np.sum(squares[part]) / np.sum(redundancy[part]))
        for part in np.array_split(order, 3)
    ]
    run = outcome.result.runs[CAMERA]
    if fold.model == CollocationModel.kind:
        sigma = outcome.calibrations[CAMERA].correct(table.uv, exact=True).sigma
        expected = expected_square(run, adjusted.solved[CAMERA], sigma, kept)
        fold.nse_correlated = float(np.sum(table.residual[kept] ** 2) / expected)


def measure(data: DataSet, mrcal: str | None, validated: bool, seed: int = 1) -> dict[str, Any]:
    """Return the results of a set as plain values; seed: of its random halves."""
    folds = [
        measure_fold(data, training, tested, mrcal, validated and k == 0)
        for k, (training, tested) in enumerate(splits(data.frames, seed))
    ]
    return {
        'name': data.name,
        'title': data.title,
        'solid': data.solid,
        'exposures': len(data.frames),
        'points': sum(len(frame.uv) for frame in data.frames),
        'targets': len(data.phantom.target_id),
        'image_size': list(data.image_size),
        'folds': [asdict(fold) for fold in folds],
    }
