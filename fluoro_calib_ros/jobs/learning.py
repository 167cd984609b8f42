# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The learning job: shapes of bodies seen by a healthy rig, used to heal it later."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..bodies.body import Body, check_bodies
from ..bodies.shapes import EstimatedShape, LearnedShapes
from ..correction.fluoroscope_calibration import Calibrations
from ..errors import DataError, ErrorsAt
from ..exposures.frame import Frames, frames_of_targets
from ..findings import Kind
from ..io.access import PathLike
from ..io.versions import LEARNED_SHAPES, read_learned_shapes
from ..photogrammetry.rig_orientation import RigOrientation
from ..reconstruction.reconstruct import orientation_of_recorded
from .bodies import BodiesOptions, estimated_shapes, intersected
from .healing import MIN_EXPOSURES

# Findings for which the shape of a body is not used; deviations from CT do not matter.
REFUSED = (
    Kind.BODY_MIRRORED,
    Kind.BODY_NOT_RIGID,
    Kind.BODY_UNSEEN,
    Kind.MARKER_LOOSE,
    Kind.WRONG_UNIT,
)
# Findings of the drift watch in an alarm.
DRIFTED = (Kind.CLUSTER_CHANGE, Kind.IMAGE_DRIFT, Kind.RAYS_DO_NOT_MEET)


def learn_shapes(
    frames: Frames,
    calibrations: Calibrations,
    orientation: RigOrientation,
    bodies: Sequence[Body],
    options: BodiesOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> LearnedShapes:
    """Learn the shapes of bodies from a recording of a healthy rig.

    Parameters
    ----------
    frames : mapping of str to sequence of Frame
        Observed image points of the markers of bodies, by fluoroscope.
    calibrations : mapping of str to FluoroscopeCalibration
    orientation : RigOrientation
    bodies : sequence of Body
        Positions of their markers may be unknown.
    options : BodiesOptions, optional
        How frames are paired.
    progress : callable, optional
        Called with the number of intersected exposures and their total.

    Returns
    -------
    LearnedShapes
        Without bodies that are loose, soft or not seen; its findings name them.

    Raises
    ------
    DataError
        For a healed rig, for a recording with an alarm of the drift watch, for frames that cannot
        be paired or corrected, and if no shape can be learned.
    """
    if orientation.source == 'healing':
        raise DataError(
            f'{orientation.orientation_id} is a healed rig, from which no shapes are learned'
        )
    options = options or BodiesOptions()
    check_bodies(bodies)
    recorded = orientation_of_recorded(frames, orientation)
    markers = np.concatenate([body.target_id for body in bodies])
    seen = frames_of_targets(frames, markers)
    recording = intersected(seen, calibrations, recorded, options, progress)
    exposures = recording.frames
    drift = recording.drift
    if drift is not None and drift.state is not None:
        raise DataError(replace(drift.finding, advice='no shapes are learned during a drift'))
    shapes = estimated_shapes(bodies, recording, calibrations)
    learned = [_known(shape.body) for shape in shapes if _is_good(shape)]
    findings = [finding for shape in shapes for finding in shape.findings]
    if not learned:
        raise DataError(
            *[finding for finding in findings if finding.kind in REFUSED],
            f'no body has a shape from {MIN_EXPOSURES} exposures or more, none is learned',
        )
    return LearnedShapes(
        tuple(learned),
        (orientation.orientation_id,),
        dict(zip(orientation.fluoroscopes, orientation.calibration_ids)),
        begin_ns=exposures[0].stamp_ns,
        end_ns=exposures[-1].stamp_ns,
        exposures=len(exposures),
        findings=tuple(findings),
    )


def learned_for(directory: PathLike, orientation: RigOrientation) -> LearnedShapes:
    """Return the learned shapes in a folder of calibrations for one of its orientations.

    Raises DataError if there are none, or if they belong to another calibration.
    """
    if not (Path(directory) / LEARNED_SHAPES).exists():
        raise DataError(
            f'{directory}: no shapes of bodies were learned while the rig was healthy; learn '
            'them with fluoro-calib bodies --learn, or the parameter learn_bodies of '
            'calibration_node'
        )
    learned = read_learned_shapes(directory)
    with ErrorsAt(directory):
        learned.check(orientation.orientation_id)
    return learned


def _is_good(shape: EstimatedShape) -> bool:
    """Return whether a shape may be compared with later observations of a rig."""
    enough = shape.exposures >= MIN_EXPOSURES and int(shape.body.known.sum()) >= 3
    return enough and not any(finding.kind in REFUSED for finding in shape.findings)


def _known(body: Body) -> Body:
    """Return a body with only the markers that were seen."""
    return body.rows(body.known & np.isfinite(body.sd_mm))
