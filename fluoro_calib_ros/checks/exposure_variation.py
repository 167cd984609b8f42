# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Check 'variation': the distortion is the same in all exposures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..estimation.exposure_terms import VARYING
from ..exposures.frame import angles_of
from ..findings import Kind, Place
from .calibration_evidence import Evidence, Subject
from .check import Check, more_exposures, too_little_data

# Size of a change, over the standard deviation of residuals, up to which it is no fault. A later
# exposure has it as an error beside its noise, which is larger than residuals: the errors of its
# points are then up to 8 % larger.
HARMLESS = 0.45
# Range [rad] of angles in degrees that is not larger than a full turn in radians.
LARGEST_RADIANS = np.deg2rad(2 * np.pi)


def check_variation(evidence: Evidence, names: Sequence[str]) -> list[Check]:
    """Fit low-order terms to the residuals of each exposure; a check for each fluoroscope."""
    return [_check(evidence, name) for name in names]


def _check(evidence: Evidence, name: str) -> Check:
    count = len(evidence.frames[name])
    found = evidence.variations[name]
    if found is None:
        reason = 'too few exposures have enough image points'
        return too_little_data(Kind.VARIATION, name, reason, count)
    return Check(
        Kind.VARIATION,
        f'the distortion differs between exposures by {found.size_px:.2f} px '
        f'(chi2/dof {found.chi2_per_dof:.2f}, constant up to {VARYING:.2f})',
        Place((name,)),
        f'{_angles(evidence, name)}, a lens that was focused or zoomed, a source or detector '
        'that is not rigid, or a phantom that moved, was bent or is surveyed wrongly; '
        f'{more_exposures(count)} at the angle and setting that are used, or calibrate each'
        + _how_to_give_angles(evidence, name),
        numbers={
            'chi2_per_dof': found.chi2_per_dof,
            'noise_px': found.noise_px,
            'angle_range_deg': float(np.rad2deg(np.ptp(angles_of(evidence.frames[name])))),
        },
        value=found.size_px,
        limit=HARMLESS * found.noise_px,
        unit='px',
    ).after_trend(evidence.trends[name].is_significant)


def _angles(evidence: Evidence, name: str) -> str:
    """What may be wrong with the angles of the C-arm."""
    angles = angles_of(evidence.frames[name])
    if not np.isfinite(angles).all() or np.ptp(angles) == 0:
        return 'a C-arm at another angle'
    if np.ptp(angles) < LARGEST_RADIANS:
        return 'angles of the C-arm that are in radians, not in degrees'
    return 'angles of the C-arm that are not those of these exposures'


def _how_to_give_angles(evidence: Evidence, name: str) -> str:
    """What else helps where the angles of the C-arm are unknown."""
    if np.isfinite(angles_of(evidence.frames[name])).all():
        return ''
    return '; or give the angle of the C-arm with each exposure (angle_deg, or joint_states)'


VARIATION = Subject(check_variation)
