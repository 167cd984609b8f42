# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A virtual knee that lands: its recording, and how good its live angles are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..bodies.joints import JointMotion
from ..io.access import make_folder, write_bytes
from ..jobs.simulation import BODIES, JOINTS, TRUTH, write_bag, write_knee
from ..report.motion_figure import joint_figure
from ..report.style import png_bytes
from ..simulation.knee import LANDING_HZ, LANDING_S, landing, simulate_knee, virtual_knee
from .image_twin import RecordedRig

PLAYED = 0.2  # of the speed of the recording, for a machine with two cores


class LiveKnee:
    """Bodies, joint and recording of a knee in the rig of the bags.

    recorded: the virtual rig of the bags. out: folder to write.
    """

    def __init__(self, recorded: RecordedRig, out: Path) -> None:
        self._knee = virtual_knee(recorded.seed)
        times_s = np.arange(round(LANDING_S * LANDING_HZ)) / LANDING_HZ
        self._truth = landing(self._knee, times_s)
        frames = simulate_knee(recorded.rig, self._knee, self._truth, recorded.noise_px).frames
        self.bag = out / 'landing'
        self.parameters = {'bodies': out / BODIES, 'joints': out / JOINTS}
        self.frames = {name: len(of_view) for name, of_view in frames.items()}
        make_folder(out / TRUTH)
        write_knee(out, self._knee)
        write_bag(self.bag, frames)

    def assess(self, messages: Sequence[Any], picture: Path) -> str:
        """Draw the live angles of JointAngles, and return how good they are in one line."""
        number = np.array([message.frame_number for message in messages])
        stamps = [message.header.stamp for message in messages]
        metres = np.repeat([1.0, 1e3], 3)
        covariance = np.array([message.covariance for message in messages]).reshape(-1, 6, 6)
        motion = JointMotion(
            self._knee.joint,
            number,
            np.array([10**9 * stamp.sec + stamp.nanosec for stamp in stamps]),
            angles=np.array([message.angle for message in messages]),
            translations=1e3 * np.array([message.translation for message in messages]),
            covariance=covariance * metres * metres[:, None],
            status=np.array([message.status[0] for message in messages]),
        )
        write_bytes(picture, png_bytes(joint_figure(motion)))
        known = np.isfinite(motion.angles).all(axis=1)
        error = motion.angles[known] - self._truth.angles[number[known] - 1]
        normalised = np.mean((error / motion.sd[known, :3]) ** 2)
        rmse = np.degrees(np.sqrt(np.mean(error**2, axis=0)))
        named = ', '.join(
            f'{name.replace("_", " ")} {value:.2f}'
            for name, value in zip(motion.angle_names, rmse)
        )
        return (
            f'Knee that lands, live: {np.count_nonzero(known)} of {len(self._truth.angles)} '
            f'exposures; RMSE against the truth [degrees]: {named}; squared error over its '
            f'variance {normalised:.2f}; picture {picture}'
        )
