# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Degenerate numbers in a whole calibration: noise, survey, coincident or collinear points."""

from __future__ import annotations

import functools
import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.exposures.frame import Frame, validate_frame
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.io.observations import read_observations_csv, write_observations_csv
from fluoro_calib_ros.io.phantom import read_phantom, write_phantom
from fluoro_calib_ros.jobs.calibration import run_calibration
from fluoro_calib_ros.simulation.rig import simulate_exposures

from ..harness import Target
from ..seeds import rig

FIELDS = ('u', 'v', 'uv', 'sigma', 'xyz', 'x', 'y', 'z', 'sd')
HOWS = ('all', 'one', 'exposure', 'scale', 'line')
VALUES = (
    *(0.0, -1.0, 1.0, 511.5, 1023.0, 1e-9, 1e-300, 5e-324, 1e9, 1e15, 1e30, 1e150, 1e300),
    *(1.7e308, -1e300, 1e-5, 1e5),
)
EXPOSURES = 3
INPUT = struct.Struct('<BBB')  # field, kind of change, value


@functools.cache
def _frames() -> list[Frame]:
    return simulate_exposures(rig(), EXPOSURES, 1).frames['a']


def _changed(values: np.ndarray, how: str, value: float) -> np.ndarray:
    """Return numbers (n,) with all, one or some replaced by the value, or multiplied by it."""
    out = np.array(values, dtype=float)
    if how == 'scale':
        with np.errstate(over='ignore'):
            return out * value
    if how == 'line':
        with np.errstate(over='ignore'):
            return value * np.arange(len(out))
    out[: 1 if how == 'one' else None] = value
    return out


def _with_change(
    frame: Frame, phantom: Phantom, field: str, how: str, value: float
) -> tuple[Frame, Phantom]:
    uv = frame.uv.copy()
    sigma = frame.sigma
    xyz = phantom.xyz_mm.copy()
    sd = phantom.sd_mm
    for axis, name in enumerate('uv'):
        if name in field:
            uv[:, axis] = _changed(uv[:, axis], how, value)
    if field == 'sigma':
        sigma = _changed(np.ones(len(uv)), how, value)
    for axis, name in enumerate('xyz'):
        if name in field:
            xyz[:, axis] = _changed(xyz[:, axis], how, value)
    if field == 'sd':
        sd = _changed(sd, how, value)
    return replace(frame, uv=uv, sigma=sigma), Phantom(phantom.target_id, xyz, sd)


def _read(path: Path) -> None:
    data = path.read_bytes().ljust(INPUT.size, b'\0')
    frames: Sequence[Frame] = _frames()
    phantom = rig().phantom
    for at in range(0, min(len(data) - INPUT.size + 1, 2 * INPUT.size), INPUT.size):
        field, how, value = (
            choices[byte % len(choices)]
            for choices, byte in zip((FIELDS, HOWS, VALUES), INPUT.unpack_from(data, at))
        )
        whole = how != 'exposure'
        changed = [_with_change(f, phantom, field, how, value) for f in frames]
        frames = [c[0] if whole or not i else frames[i] for i, c in enumerate(changed)]
        phantom = changed[0][1]
    calibrate(path.parent, frames, phantom)


def calibrate(folder: Path, frames: Sequence[Frame], phantom: Phantom) -> None:
    """Calibrate from files, as the command does. Raise DataError if the input is refused."""
    write_observations_csv(folder / 'observations.csv', frames)
    write_phantom(folder / 'phantom.csv', phantom)
    read = read_observations_csv(folder / 'observations.csv', frames[0].image_size)
    survey = read_phantom(folder / 'phantom.csv')
    for of_one in read.values():
        for frame in of_one:
            validate_frame(frame, survey)
    options = CalibrationOptions(model='none', max_iterations=2)
    outcome = run_calibration(CalibrationRequest(read, survey, options, False))
    interior = outcome.calibrations['a'].interior
    if not np.isfinite(interior).all():
        raise DataError('the result is not finite')


TARGET = Target(
    'numbers',
    'choices',
    _read,
    lambda: [INPUT.pack(f, h, v) for f in range(len(FIELDS)) for h in range(2) for v in (3, 9)],
)
