# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The folder with the bodies of a recording."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence

import numpy as np

from ..bodies.joints import JointMotion
from ..findings import sentences
from ..io.access import PathLike
from ..io.atomic import write_text
from ..io.bodies import write_bodies
from ..io.folder import FolderKind, check_output_folder, replaced_folder
from ..io.formats.opensim import write_joint_motion
from ..io.joints import write_joints
from ..io.poses import write_motion, write_poses
from .bodies import BodiesOutcome
from .bodies_film import Film, write_films

POSES = 'poses.csv'
MOTION = 'motion.csv'
SHAPES = 'shapes.csv'
JOINTS = 'joints.csv'
OPENSIM = 'joints.mot'
REPORT = 'report.html'
FILM = re.compile(r'film_\w+\.mp4')
NAMES = (POSES, MOTION, SHAPES, JOINTS, OPENSIM, REPORT)


def _is_own(name: str) -> bool:
    return (
        name in NAMES
        or bool(FILM.fullmatch(name))
        or (name.startswith('.') and name.endswith('.tmp'))
    )


def _marks(name: str) -> bool:
    return name == POSES


BODIES_FOLDER = FolderKind('a folder of bodies', _is_own, _marks)


def check_bodies_folder(directory: PathLike, inputs: Iterable[PathLike]) -> None:
    """Raise DataError unless the bodies of a recording may be written to a folder."""
    check_output_folder(directory, BODIES_FOLDER, inputs)


def save_bodies(
    directory: PathLike, outcome: BodiesOutcome, report: bool = False, film: Film | None = None
) -> None:
    """Write poses, motion, shapes and joints, all or nothing; with report and films on request.

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
        if report:
            from ..report.bodies import bodies_html

            title = os.path.basename(os.path.abspath(directory))
            text = bodies_html(
                title,
                outcome.poses,
                outcome.joints,
                summary=outcome.summary(),
                findings=sentences(outcome.findings),
            )
            write_text(folder / REPORT, text)
        if film is not None:
            write_films(folder, film, outcome.bodies, outcome.poses)


def _some_exposure_has_all(joints: Sequence[JointMotion]) -> bool:
    """Return whether the motion of all joints is known in an exposure, as OpenSim needs it."""
    known = [np.isfinite(motion.angles).all(axis=1) for motion in joints]
    return bool(known) and bool(np.all(known, axis=0).any())
