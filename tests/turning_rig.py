# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Exposures of the virtual rig with a distortion that turns with a C-arm."""

import functools
from dataclasses import replace

import numpy as np
from rigs import exposures, rig

from fluoro_calib_ros.estimation.calibrate import calibrate

CHANGE_PX = 2.0


def turned(uv, angle, size):
    """Return the change (n, 2) [px] of the distortion with an angle, at pixels uv (n, 2)."""
    x, y = ((uv - (np.asarray(size) - 1) / 2) / (max(size) / 2)).T
    spiral = (x * x + y * y)[:, None] * np.column_stack([-y, x])
    bend = np.column_stack([x * x, -y * y]) * y[:, None]
    return CHANGE_PX * (np.cos(angle) * spiral + np.sin(angle) * bend)


def recording(known=True):
    """Return frames of 22 exposures at angles: 14 for the calibration and 8 for the test.

    They show two thirds of the targets, which is enough to estimate the change with the angle.
    """
    return _recording(known)  # a cached function would treat f() and f(True) differently


@functools.cache
def _recording(known):
    rng = np.random.default_rng(5)
    out = []
    for frame in exposures(22, seed=11)['a']:
        angle = float(rng.uniform(-1.4, 1.4))
        uv = frame.uv + turned(frame.uv, angle, frame.image_size)
        width, height = frame.image_size
        on = ((uv > 0) & (uv < [width - 1, height - 1])).all(axis=1) & (frame.target_id % 3 > 0)
        out.append(
            replace(
                frame,
                target_id=frame.target_id[on],
                uv=uv[on],
                sigma=None if frame.sigma is None else frame.sigma[on],
                angle=angle if known else None,
            )
        )
    return out[:14], out[14:]


def turning(known=True):
    """Return the calibration of these exposures."""
    return _turning(known)


@functools.cache
def _turning(known):
    return calibrate({'a': recording(known)[0]}, rig().phantom)
