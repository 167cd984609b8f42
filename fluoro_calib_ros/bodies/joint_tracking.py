# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Motion of a joint exposure by exposure, with the numbers of the whole trial."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from .body import BodyPoses
from .joints import Joint, JointMotion, JointStatus, joint_motion, with_neutral

MAX_NEUTRAL = 10_000  # exposures of a neutral trial, some 60 MB
# Full turns are counted from angles of these: not of those near gimbal lock, which may turn.
_FIRM = (JointStatus.OK, JointStatus.WEAK, JointStatus.FILLED)


class JointTracker:
    """Follows a joint from exposure to exposure.

    Until the neutral trial has passed, angles of a joint that needs one are unknown.

    Parameters
    ----------
    joint : Joint
    neutral : (int, int) or None
        First and last exposure in neutral position. Raises DataError for more than MAX_NEUTRAL.
    """

    def __init__(self, joint: Joint, neutral: tuple[int, int] | None = None) -> None:
        if neutral is not None and neutral[1] - neutral[0] >= MAX_NEUTRAL:
            raise DataError(
                f'joint {joint.name}: a neutral trial from exposure {neutral[0]} to {neutral[1]}; '
                f'live it has at most {MAX_NEUTRAL} exposures'
            )
        self.joint = joint
        self._neutral = neutral
        self._collected: list[tuple[BodyPoses, BodyPoses]] = []
        self._last: NDArray[np.float64] | None = None
        self.needs_neutral = neutral is not None  #: whether the neutral trial has not passed yet
        #: why a neutral trial that has passed gave no neutral position
        self.error: DataError | None = None

    def add(self, proximal: BodyPoses, distal: BodyPoses) -> JointMotion:
        """Return the motion in the next exposure, from the poses of both bodies in it."""
        if self.needs_neutral:
            self._collect(proximal, distal)
        motion = joint_motion(self.joint, proximal, distal, self._last)
        if self.needs_neutral:
            return _unknown(motion)
        if motion.status[0] in _FIRM:
            self._last = motion.angles[0]
        return motion

    def _collect(self, proximal: BodyPoses, distal: BodyPoses) -> None:
        """Take an exposure of the neutral trial; at its end use the neutral position."""
        assert self._neutral is not None
        first, last = self._neutral
        number = int(proximal.number[0])
        if first <= number <= last:
            self._collected.append((proximal, distal))
        if number < last or self.error is not None:
            return
        collected, self._collected = self._collected, []
        if not collected:
            self.error = DataError(f'joint {self.joint.name}: the neutral trial was not seen')
            return
        try:
            both = (_joined(poses) for poses in zip(*collected))
            self.joint = with_neutral(self.joint, *both)
            self.needs_neutral = False
        except DataError as error:
            self.error = error


def _joined(poses: Sequence[BodyPoses]) -> BodyPoses:
    """Poses of several exposures as those of one trial."""
    names = [entry.name for entry in fields(BodyPoses) if entry.name != 'body']
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(one, name) for one in poses]) for name in names
    }
    return replace(poses[0], **joined)


def _unknown(motion: JointMotion) -> JointMotion:
    """The same exposures without angles and translations."""
    return replace(
        motion,
        angles=np.full_like(motion.angles, np.nan),
        translations=np.full_like(motion.translations, np.nan),
        covariance=np.full_like(motion.covariance, np.nan),
        status=np.full_like(motion.status, JointStatus.FAILED),
    )
