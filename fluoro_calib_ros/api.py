# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The public Python interface; `import fluoro_calib_ros as fc` offers the same names.

Nothing here needs ROS. Frames are passed as {fluoroscope: [Frame, ...]}, calibrations as
{fluoroscope: FluoroscopeCalibration}.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from .bodies.body import Body, BodyPoses
from .bodies.joints import Joint, JointMotion
from .bodies.shapes import LearnedShapes
from .checks.check import Validation
from .checks.verdict import validate
from .correction.fluoroscope_calibration import CorrectedPoints, FluoroscopeCalibration
from .errors import DataError
from .estimation.options import CalibrationOptions, CalibrationRequest
from .estimation.result import CalibrationResult
from .estimation.rounds import Round
from .estimation.survey import MeasuredDistance
from .exposures.frame import Frame, MovingPoints
from .exposures.names import Names
from .exposures.phantom import Phantom
from .findings import Finding, Kind, Severity
from .io.access import PathLike
from .io.bodies import JointEntry, read_bodies, read_joints, write_bodies, write_reconstruction
from .io.calibration import load_orientation, save_orientation
from .io.calibration_request import read_request
from .io.formats.content import FileSettings
from .io.phantom import read_moving_points, read_phantom, write_phantom
from .io.versions import read_learned_shapes, write_learned_shapes
from .jobs.bodies import BodiesOptions, BodiesOutcome, save_bodies, track_bodies
from .jobs.calibration import CalibrationOutcome, adjust, run_calibration
from .jobs.conversion import ConversionRequest, convert
from .jobs.extraction import ExtractionOutcome, ExtractionRequest, recording_of_images
from .jobs.extraction import run_extraction as extract
from .jobs.healing import HealingOptions, HealingOutcome, heal_rig, save_healing
from .jobs.image_sources import contains_images
from .jobs.learning import learn_shapes
from .jobs.orientation import OrientationOutcome, orient
from .jobs.reconstruction import ReconstructionOptions, ReconstructionOutcome, reconstruct
from .jobs.result_folder import save_outcome, save_result
from .jobs.simulation import SimulationOptions, simulate
from .jobs.sources import (
    BagSelection,
    Recording,
    Survey,
    read_calibrations,
    read_orientations,
    read_source,
    read_survey,
)
from .jobs.survey import SurveyOutcome, SurveyRequest, survey
from .photogrammetry.rig_orientation import KnownOrientation, RigOrientation

__all__ = [
    'BodiesOptions',
    'BodiesOutcome',
    'Body',
    'BodyPoses',
    'CalibrationOptions',
    'CalibrationOutcome',
    'CalibrationRequest',
    'CalibrationResult',
    'ConversionRequest',
    'CorrectedPoints',
    'DataError',
    'ExtractionOutcome',
    'ExtractionRequest',
    'FileSettings',
    'Finding',
    'FluoroscopeCalibration',
    'Frame',
    'HealingOptions',
    'HealingOutcome',
    'Joint',
    'JointEntry',
    'JointMotion',
    'Kind',
    'KnownOrientation',
    'LearnedShapes',
    'MeasuredDistance',
    'MovingPoints',
    'Names',
    'OrientationOutcome',
    'Phantom',
    'ReconstructionOptions',
    'ReconstructionOutcome',
    'Recording',
    'RigOrientation',
    'Severity',
    'SimulationOptions',
    'Survey',
    'SurveyOutcome',
    'SurveyRequest',
    'Validation',
    'adjust',
    'calibrate',
    'calibrate_with_known_orientations',
    'convert',
    'correct',
    'extract',
    'heal_rig',
    'learn_shapes',
    'load_orientation',
    'orient',
    'read_bodies',
    'read_calibrations',
    'read_joints',
    'read_learned_shapes',
    'read_moving_points',
    'read_orientations',
    'read_phantom',
    'read_request',
    'read_source',
    'read_survey',
    'reconstruct',
    'run_calibration',
    'save_bodies',
    'save_healing',
    'save_orientation',
    'save_outcome',
    'save_result',
    'simulate',
    'survey',
    'track_bodies',
    'validate',
    'write_bodies',
    'write_learned_shapes',
    'write_phantom',
    'write_reconstruction',
]


def calibrate(
    frames: Mapping[str, Sequence[Frame]] | Recording | PathLike,
    phantom: Phantom | Survey | PathLike,
    options: CalibrationOptions | None = None,
    *,
    joint: bool = False,
    principal_distance: float | None = None,
    validated: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
) -> CalibrationOutcome:
    """Self-calibrate fluoroscopes, and orient the rig.

    Parameters
    ----------
    frames : mapping of str to sequence of Frame, Recording, or path-like
        Exposures of the phantom by fluoroscope; or a bag or file with them, or a folder with one
        folder of images per fluoroscope. A file without image size, such as a CSV file, is read
        by `read_source`, which takes it; with FileSettings(names=survey.names) if it has names.
    phantom : Phantom, Survey or path-like
        The surveyed phantom, or the file of the survey. Names of a Survey and a Recording are
        saved with the result.
    options : CalibrationOptions, optional
    joint : bool
        Whether all fluoroscopes are adjusted together; otherwise one after the other.
    principal_distance : float, optional
        Initial value [px], or the fixed value if interior is 'fixed'.
    validated : bool
        Whether the calibration is validated with its own exposures, which takes about six times as
        long.
    progress : callable, optional
        Called after every image and round, and before every step of the validation, with a text,
        the number completed and the total, which is 0 for rounds; may raise to stop.

    Returns
    -------
    CalibrationOutcome
        `save_outcome` writes it into a result folder.

    Raises
    ------
    DataError
        For observations that do not suffice or cannot be right; the message states place and
        cause. `run_calibration` can calibrate from these, too.
    ValueError
        For options that contradict each other.
    """
    if isinstance(phantom, Phantom):
        phantom = Survey(phantom, Names())
    survey = phantom if isinstance(phantom, Survey) else read_survey(phantom)
    if isinstance(frames, Mapping):
        frames = Recording({name: list(view_frames) for name, view_frames in frames.items()})
    if not isinstance(frames, Recording):
        frames = _recording_in(Path(frames), survey, principal_distance, progress)
    request = CalibrationRequest(
        frames.frames,
        survey.phantom,
        options or CalibrationOptions(),
        joint,
        principal_distance,
        names=survey.names.merged(frames.names),
    )
    return _calibrated(request, validated, progress)


def calibrate_with_known_orientations(
    frames: Mapping[str, Sequence[Frame]],
    phantom: Phantom,
    known: Mapping[str, KnownOrientation],
    options: CalibrationOptions | None = None,
    *,
    validated: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
) -> CalibrationOutcome:
    """Estimate the distortion of fluoroscopes whose K, R and t are known.

    Parameters
    ----------
    frames : mapping of str to sequence of Frame
        Exposures by fluoroscope.
    phantom : Phantom
        Targets in the laboratory frame; `MovingPoints.as_phantom` creates one from moving points.
    known : mapping of str to KnownOrientation
        By fluoroscope; fixed, or weighted by its standard deviations.
    options : CalibrationOptions, optional
    validated : bool
        Whether the calibration is validated with its own exposures.
    progress : callable, optional
        Called as by `calibrate`.

    Returns
    -------
    CalibrationOutcome

    Raises
    ------
    DataError
        For observations that do not suffice or cannot be right; the message states place and
        cause.
    """
    request = CalibrationRequest(
        frames, phantom, options or CalibrationOptions(), known_orientations=known
    )
    return _calibrated(request, validated, progress)


def _recording_in(
    source: Path,
    survey: Survey,
    principal_distance: float | None,
    progress: Callable[[str, int, int], None] | None,
) -> Recording:
    """Read the exposures of a bag or file, or extract the beads of images. Raises DataError."""
    if not contains_images(source):
        settings = FileSettings(names=survey.names)
        selection = BagSelection(phantom=survey.phantom)
        return read_source(source, collect='auto', settings=settings, selection=selection)
    report_image = None if progress is None else partial(progress, 'image')
    return recording_of_images(
        source, survey, principal_distance_px=principal_distance, progress=report_image
    )


def _calibrated(
    request: CalibrationRequest,
    validated: bool,
    progress: Callable[[str, int, int], None] | None,
) -> CalibrationOutcome:
    """Run a calibration that reports its rounds in the same way as the steps of its validation."""

    def report(names: str, step: Round) -> None:
        if progress is not None:
            progress(f'{names}: {step}', step.iteration, 0)

    return run_calibration(request, validate=validated, progress=report, report_step=progress)


def correct(
    calibration: FluoroscopeCalibration,
    uv: ArrayLike,
    sigma: ArrayLike | None = None,
    angle: ArrayLike | None = None,
) -> CorrectedPoints:
    """Remove the distortion from observed image points.

    uv (n, 2) are observed pixels, sigma (n,) their standard deviations [px], by default that of
    the calibration. angle: of the C-arm [rad], a number or (n,), if the correction depends on it.
    Raises DataError for arrays of another shape.
    """
    uv = np.asarray(uv, dtype=float)
    if uv.ndim != 2 or uv.shape[1] != 2:
        raise DataError(f'uv has the shape {uv.shape}, expected (n, 2)')
    if sigma is not None:
        sigma = np.asarray(sigma, dtype=float)
        if sigma.shape != (len(uv),):
            raise DataError(f'sigma has the shape {sigma.shape}, expected ({len(uv)},)')
    return calibration.correct(uv, sigma, angle=angle)
