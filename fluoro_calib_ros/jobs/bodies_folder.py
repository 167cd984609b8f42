# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The folder with the bodies of a recording."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from ..bodies.joints import JointMotion
from ..io.access import PathLike
from ..io.bodies import write_bodies
from ..io.folder import FolderKind, check_output_folder, replaced_folder
from ..io.formats.opensim import write_joint_motion
from ..io.joints import write_joints
from ..io.poses import write_motion, write_poses
from .bodies import BodiesOutcome

POSES = 'poses.csv'
MOTION = 'motion.csv'
SHAPES = 'shapes.csv'
JOINTS = 'joints.csv'
OPENSIM = 'joints.mot'
FIGURES = 'figures'
NAMES = (POSES, MOTION, SHAPES, JOINTS, OPENSIM, FIGURES)


def _is_own(name: str) -> bool:
    return name in NAMES or (name.startswith('.') and name.endswith('.tmp'))


def _marks(name: str) -> bool:
    return name == POSES


BODIES_FOLDER = FolderKind('a folder of bodies', _is_own, _marks)


def check_bodies_folder(directory: PathLike, inputs: Iterable[PathLike]) -> None:
    """Raise DataError unless the bodies of a recording may be written to a folder."""
    check_output_folder(directory, BODIES_FOLDER, inputs)


def save_bodies(directory: PathLike, outcome: BodiesOutcome, figures: bool = False) -> None:
    """Write poses, motion, shapes and joints, all or nothing; with pictures of them on request.

    Raises DataError.
    """
    start_ns = int(outcome.exposures[0].stamp_ns)
    with replaced_folder(directory, BODIES_FOLDER) as folder:
        write_poses(folder / POSES, outcome.poses, start_ns)
        write_motion(folder / MOTION, outcome.bodies, outcome.exposures, start_ns)
        write_bodies(folder / SHAPES, outcome.bodies)
        if outcome.joints:
            write_joints(folder / JOINTS, outcome.joints, start_ns)
        if _some_exposure_has_all(outcome.joints):
            write_joint_motion(folder / OPENSIM, outcome.joints, start_ns)
        if figures:
            from ..report.motion_figure import write_motion_figures

            write_motion_figures(folder / FIGURES, outcome.joints, outcome.poses)


def _some_exposure_has_all(joints: Sequence[JointMotion]) -> bool:
    """Return whether the motion of all joints is known in an exposure, as OpenSim needs it."""
    known = [np.isfinite(motion.angles).all(axis=1) for motion in joints]
    return bool(known) and bool(np.all(known, axis=0).any())
