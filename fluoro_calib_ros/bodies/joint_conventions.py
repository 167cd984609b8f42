# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Conventions of joints: sequences of rotations, and which sign has which clinical name.

A joint coordinate system after Grood and Suntay (1983) is a Cardan sequence: the first axis is
one of the proximal bone, the third one of the distal bone, and the second (floating) axis is
perpendicular to both. R = R_i(1) R_j(2) R_k(3) takes distal into proximal axes. The sources are
those of `anatomical_frames`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from .anatomical_frames import AXES, SIDES


@dataclass(frozen=True)
class Convention:
    """How the motion of a joint is expressed."""

    name: str
    sequence: str  #: axes of the rotations, such as 'zxy'
    #: names; each says which direction is positive
    angles: tuple[str, str, str]
    translations: tuple[str, str, str]
    #: of the named quantities, of a right limb
    angle_signs: tuple[int, int, int] = (1, 1, 1)
    translation_signs: tuple[int, int, int] = (1, 1, 1)
    #: number of the axis that points to the right of the person: a left limb is mirrored along it;
    #: None where sides do not differ
    lateral: int | None = None
    #: whether translations are along the three axes of rotation, or else along x, y and z of the
    #: proximal frame
    along_axes: bool = True
    branch: int = 1  #: sign of the second angle of an Euler sequence
    #: kinds of landmark frames, empty where there are none
    proximal_landmarks: str = ''
    distal_landmarks: str = ''

    @property
    def is_euler(self) -> bool:
        """Whether the first and the third axis have the same name."""
        return self.sequence[0] == self.sequence[2]

    def mirror(self, side: str) -> NDArray[np.float64]:
        """Return the matrix (3, 3) that makes a right limb of one of this side."""
        matrix = np.eye(3)
        if side == 'left' and self.lateral is not None:
            matrix[self.lateral, self.lateral] = -1
        return matrix

    def check_side(self, side: str) -> None:
        """Raise DataError for a side that is none, or missing where it matters."""
        if side not in SIDES and (side or self.lateral is not None):
            raise DataError(f'the side is {side!r}, {self.name} needs left or right')


def _sequences() -> Iterator[Convention]:
    """Yield the six Cardan and six Euler sequences."""
    for a, b, c in product(AXES, repeat=3):
        if a == b or b == c:
            continue
        last = ('1', '2') if a == c else ('', '')
        yield Convention(
            f'{"euler" if a == c else "cardan"}_{a}{b}{c}',
            f'{a}{b}{c}',
            angles=(f'rotation_{a}{last[0]}', f'rotation_{b}', f'rotation_{c}{last[1]}'),
            translations=('translation_x', 'translation_y', 'translation_z'),
            along_axes=False,
        )


def _isb(name: str, angles: str, translations: str, proximal: str, distal: str) -> Convention:
    """Return a convention of the ISB: flexion about z, the floating x, rotation about y."""
    first, second, third = angles.split()
    lateral, anterior, along = translations.split()
    return Convention(
        name,
        'zxy',
        angles=(first, second, third),
        translations=(lateral, anterior, along),
        lateral=2,
        proximal_landmarks=proximal,
        distal_landmarks=distal,
    )


# Elevation is the negative rotation about x, in a plane turned about y.
_SHOULDER = Convention(
    'isb_glenohumeral',
    'yxy',
    angles=('plane_of_elevation', 'elevation', 'internal_rotation'),
    translations=('translation_x', 'translation_y', 'translation_z'),
    angle_signs=(1, -1, 1),
    lateral=2,
    along_axes=False,
    branch=-1,
    proximal_landmarks='scapula_isb',
    distal_landmarks='humerus_isb',
)
_SHIFTS = 'lateral_shift anterior_shift proximal_shift'
_CLINICAL = (
    # Flexion turns the distal end of the tibia back, against the right-hand rule about x.
    Convention(
        'grood_suntay_knee',
        'xyz',
        angles=('flexion', 'adduction', 'internal_rotation'),
        translations=('lateral_shift', 'anterior_drawer', 'distraction'),
        angle_signs=(-1, 1, 1),
        translation_signs=(1, 1, -1),
        lateral=0,
        proximal_landmarks='femur_grood_suntay',
        distal_landmarks='tibia_grood_suntay',
    ),
    _isb('isb_hip', 'flexion adduction internal_rotation', _SHIFTS, 'pelvis_isb', 'femur_isb'),
    # The frame of the calcaneus is that of the tibia in neutral position.
    _isb(
        'isb_ankle',
        'dorsiflexion inversion internal_rotation',
        'lateral_shift anterior_shift compression',
        'tibia_isb',
        '',
    ),
    _isb('isb_elbow', 'flexion adduction pronation', _SHIFTS, 'humerus_isb', 'forearm_isb'),
    _isb(
        'isb_wrist',
        'flexion ulnar_deviation pronation',
        'radial_shift volar_shift proximal_shift',
        'radius_isb',
        'metacarpal_isb',
    ),
    _SHOULDER,
    replace(_SHOULDER, name='isb_thoracohumeral', proximal_landmarks='thorax_isb'),
)

CONVENTIONS = {one.name: one for one in (*_sequences(), *_CLINICAL)}


def convention(name: str) -> Convention:
    """Return the convention of a name. Raises DataError for an unknown one."""
    if name not in CONVENTIONS:
        raise DataError(f'the convention {name!r} is unknown, there are {", ".join(CONVENTIONS)}')
    return CONVENTIONS[name]
