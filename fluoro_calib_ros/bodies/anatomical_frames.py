# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Anatomical frames of bones: from a matrix, from axes, or from landmarks.

Sources of the landmark frames: Grood and Suntay, "A joint coordinate system for the clinical
description of three-dimensional motions: application to the knee", J. Biomech. Eng. 105 (1983);
Wu et al., "ISB recommendation on definitions of joint coordinate system ... part I: ankle, hip,
and spine", J. Biomech. 35 (2002), and "... part II: shoulder, elbow, wrist and hand", J. Biomech.
38 (2005). Grood and Suntay: x right, y anterior, z proximal. ISB: x anterior, y proximal, z right.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import DataError
from ..findings import Kind
from ..photogrammetry.rotations import (
    ROTATION_TOLERANCE,
    is_rotation,
    matrix_from_quaternion,
    nearest_rotation,
)

AXES = 'xyz'
SIDES = ('left', 'right')
# If a landmark is picked to 1 mm, the direction of a line of 50 mm is uncertain by this [rad].
MIN_SINE = 0.02
MIN_LENGTH_MM = 1.0
# Minimum sine of the angle of both directions of a frame. They are 80 to 100 degrees apart in long
# bones, and 60 in the thorax.
MIN_SINE_OF_BONE = 0.7
# Maximum ratio of the extents of the landmarks of two bones at a joint. It is 2 for femur, tibia
# and pelvis, and 4 for radius and metacarpal.
MAX_RATIO = 6.0


@dataclass(frozen=True)
class AnatomicalFrame:
    """Axes of a bone in the coordinates of its body.

    Raises DataError for axes that are not finite, not perpendicular or left-handed.
    """

    #: (3, 3) columns are the x, y and z axis; unit lengths and right angles to ROTATION_TOLERANCE
    rotation: NDArray[np.float64]
    origin_mm: NDArray[np.float64]  #: (3,)
    landmarks_mm: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))  #: (n, 3)

    def __post_init__(self) -> None:
        rotation = np.array(self.rotation, dtype=float)
        origin = np.array(self.origin_mm, dtype=float)
        if rotation.shape != (3, 3) or origin.shape != (3,):
            raise DataError('a frame has three axes and an origin of three coordinates')
        if not (np.isfinite(rotation).all() and np.isfinite(origin).all()):
            raise DataError('the frame has coordinates that are not finite')
        if is_rotation(-rotation):
            raise DataError('the axes of the frame are left-handed')
        if not is_rotation(rotation):
            raise DataError('the axes of the frame are not perpendicular unit vectors')
        for name, array in (('rotation', nearest_rotation(rotation)), ('origin_mm', origin)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def extent_mm(self) -> float:
        """Largest distance between two of its landmarks; infinite without any."""
        between = self.landmarks_mm[:, None] - self.landmarks_mm
        return float(np.linalg.norm(between, axis=2).max(initial=0.0)) or np.inf

    def check_body(self, centre_mm: NDArray[np.float64]) -> None:
        """Raise DataError for a body whose centre (3,) is farther away than its bone is long."""
        away = np.linalg.norm(self.landmarks_mm - centre_mm, axis=1).min(initial=np.inf)
        if self.extent_mm < away < np.inf:
            raise DataError(
                f'its markers are {away:.3g} mm from the nearest landmark, but the landmarks '
                f'are only {self.extent_mm:.3g} mm apart: they are in another unit, or not in '
                'the coordinates of this body',
                kind=Kind.WRONG_UNIT,
                numbers={'distance_mm': float(away), 'extent_mm': self.extent_mm},
            )


BODY_FRAME = AnatomicalFrame(np.eye(3), np.zeros(3))


def frame_of_quaternion(wxyz: ArrayLike, origin_mm: ArrayLike) -> AnatomicalFrame:
    """Return the frame of a quaternion (4,) from anatomical to body axes. Raises DataError."""
    q = np.array(wxyz, dtype=float)
    if q.shape != (4,) or not abs(np.linalg.norm(q) - 1) <= ROTATION_TOLERANCE:
        raise DataError('the quaternion of the frame does not have four numbers and length one')
    return AnatomicalFrame(matrix_from_quaternion(q), np.array(origin_mm, dtype=float))


def frame_of_axes(axes: Mapping[str, ArrayLike], origin_mm: ArrayLike) -> AnatomicalFrame:
    """Return the frame with two or three given axes x, y, z (3,) of any length.

    Raises DataError for other axes, and as AnatomicalFrame.
    """
    if not set(axes) <= set(AXES) or len(axes) < 2:
        raise DataError('a frame has two or three of the axes x, y and z')
    unit: dict[str, NDArray[np.float64]] = {}
    for name, axis in axes.items():
        vector = np.array(axis, dtype=float)
        length = np.linalg.norm(vector)
        if vector.shape != (3,) or not (0 < length < np.inf):
            raise DataError(f'the {name} axis of the frame is not a direction of three numbers')
        unit[name] = vector / length
    for index, name in enumerate(AXES):
        if name not in unit:
            unit[name] = np.cross(unit[AXES[index - 2]], unit[AXES[index - 1]])
    return AnatomicalFrame(
        np.column_stack([unit[name] for name in AXES]), np.array(origin_mm, dtype=float)
    )


@dataclass(frozen=True)
class Direction:
    """Axis from the mean of some landmarks to the mean of others.

    A lateral axis is defined for a right limb. For a left limb it is reversed, so that it also
    points to the right of the person.
    """

    axis: str
    start: tuple[str, ...]
    end: tuple[str, ...]
    lateral: bool = False


@dataclass(frozen=True)
class LandmarkFrame:
    """Definition of a frame by landmarks."""

    origin: tuple[str, ...]  #: landmarks whose mean is the origin
    first: Direction  #: one axis of the frame
    #: spans a plane with the first; its component perpendicular to the first is another axis
    second: Direction
    #: directions that anatomy puts on the positive side of their axis
    known: tuple[Direction, ...] = ()

    @property
    def landmarks(self) -> tuple[str, ...]:
        """Names of the landmarks, each once."""
        first, second = self.first, self.second
        names = (*self.origin, *first.start, *first.end, *second.start, *second.end)
        return tuple(dict.fromkeys(names))


_EPICONDYLES = ('medial_epicondyle', 'lateral_epicondyle')
_MALLEOLI = ('medial_malleolus', 'lateral_malleolus')
_EMINENCES = ('medial_eminence', 'lateral_eminence')
_RADIUS = ('proximal_radius', 'distal_radius')

LANDMARK_FRAMES = {
    # z: mechanical axis; y: perpendicular to it and to the line of the posterior condyles.
    'femur_grood_suntay': LandmarkFrame(
        ('intercondylar',),
        Direction('z', ('intercondylar',), ('femoral_head',)),
        Direction(
            'x', ('medial_posterior_condyle',), ('lateral_posterior_condyle',), lateral=True
        ),
        known=(
            Direction(
                'y', ('medial_posterior_condyle', 'lateral_posterior_condyle'), ('intercondylar',)
            ),
        ),
    ),
    'tibia_grood_suntay': LandmarkFrame(
        _EMINENCES,
        Direction('z', ('ankle_centre',), _EMINENCES),
        Direction('x', ('medial_plateau',), ('lateral_plateau',), lateral=True),
    ),
    'pelvis_isb': LandmarkFrame(
        ('hip_centre',),
        Direction('z', ('left_asis',), ('right_asis',)),
        Direction('x', ('left_psis', 'right_psis'), ('left_asis', 'right_asis')),
        known=(
            Direction('y', ('hip_centre',), ('left_asis', 'right_asis')),
            Direction('z', ('left_asis', 'right_asis'), ('hip_centre',), lateral=True),
        ),
    ),
    'femur_isb': LandmarkFrame(
        ('hip_centre',),
        Direction('y', _EPICONDYLES, ('hip_centre',)),
        Direction('z', ('medial_epicondyle',), ('lateral_epicondyle',), lateral=True),
    ),
    'tibia_isb': LandmarkFrame(
        _MALLEOLI,
        Direction('z', ('medial_malleolus',), ('lateral_malleolus',), lateral=True),
        Direction('y', _MALLEOLI, ('medial_condyle', 'lateral_condyle')),
    ),
    'thorax_isb': LandmarkFrame(
        ('suprasternal_notch',),
        Direction('y', ('xiphoid', 't8'), ('suprasternal_notch', 'c7')),
        Direction('x', ('c7',), ('suprasternal_notch',)),
    ),
    'scapula_isb': LandmarkFrame(
        ('acromial_angle',),
        Direction('z', ('trigonum_spinae',), ('acromial_angle',), lateral=True),
        Direction('y', ('inferior_angle',), ('trigonum_spinae',)),
    ),
    # First option of the recommendation: the humerus without the forearm.
    'humerus_isb': LandmarkFrame(
        ('glenohumeral_centre',),
        Direction('y', _EPICONDYLES, ('glenohumeral_centre',)),
        Direction('z', ('medial_epicondyle',), ('lateral_epicondyle',), lateral=True),
    ),
    'forearm_isb': LandmarkFrame(
        ('ulnar_styloid',),
        Direction('y', ('ulnar_styloid',), _EPICONDYLES),
        Direction('z', ('ulnar_styloid',), ('radial_styloid',), lateral=True),
    ),
    'radius_isb': LandmarkFrame(
        _RADIUS,
        Direction('y', ('distal_radius',), ('proximal_radius',)),
        Direction('z', ('sigmoid_notch',), ('radial_styloid',), lateral=True),
    ),
    # The palmar point lies in the plane that bisects the bone.
    'metacarpal_isb': LandmarkFrame(
        ('metacarpal_head', 'metacarpal_base'),
        Direction('y', ('metacarpal_head',), ('metacarpal_base',)),
        Direction('x', ('metacarpal_head', 'metacarpal_base'), ('palmar_point',)),
    ),
}


def frame_of_landmarks(
    kind: str, landmarks: Mapping[str, ArrayLike], side: str
) -> AnatomicalFrame:
    """Return the frame of a kind of bone from landmarks (3,) in the coordinates of its body [mm].

    kind is a key of LANDMARK_FRAMES, side one of SIDES. Raises DataError for landmarks that are
    missing, unknown, not finite, coincident or collinear, and for a bone that anatomy excludes.
    """
    recipe = LANDMARK_FRAMES[kind]
    names = recipe.landmarks
    for name in names:
        if name not in landmarks:
            raise DataError(
                f'the landmark {name} is missing; the landmarks are {", ".join(names)}'
            )
    for name in landmarks:
        if name not in names:
            raise DataError(f'the landmark {name} is unknown, expected one of {", ".join(names)}')
    points = {name: np.array(landmarks[name], dtype=float) for name in names}
    for name, point in points.items():
        if point.shape != (3,) or not np.isfinite(point).all():
            raise DataError(f'the landmark {name} does not have three finite coordinates')

    first = _vector(recipe.first, points, side)
    second = _vector(recipe.second, points, side)
    orthogonal = second - (second @ first) * first
    if np.linalg.norm(orthogonal) < MIN_SINE:
        raise DataError(f'the landmarks {", ".join(names)} lie on a line')
    if np.linalg.norm(orthogonal) < MIN_SINE_OF_BONE:
        degrees = float(np.rad2deg(np.arccos(abs(second @ first))))
        raise DataError(
            f'the {recipe.first.axis} axis and the direction to '
            f'{" and ".join(recipe.second.end)} are only {degrees:.0f} degrees apart, as in no '
            'bone: a coordinate of a landmark is wrong'
        )
    frame = frame_of_axes(
        {recipe.first.axis: first, recipe.second.axis: orthogonal}, _mean(recipe.origin, points)
    )
    for direction in recipe.known:
        axis = frame.rotation[:, AXES.index(direction.axis)]
        sign = -1 if direction.lateral and side == 'left' else 1
        if sign * (_mean(direction.end, points) - _mean(direction.start, points)) @ axis < 0:
            start, end = (' and '.join(names) for names in (direction.start, direction.end))
            raise DataError(
                f'the way from {start} to {end} is opposite to that in a {side} bone: the side is '
                'wrong, two landmarks are exchanged, or the bone is mirrored'
            )
    return replace(frame, landmarks_mm=np.array(list(points.values())))


def _mean(
    names: tuple[str, ...], points: Mapping[str, NDArray[np.float64]]
) -> NDArray[np.float64]:
    return np.mean([points[name] for name in names], axis=0)


def _vector(
    direction: Direction, points: Mapping[str, NDArray[np.float64]], side: str
) -> NDArray[np.float64]:
    """Return a unit vector (3,). Raises DataError for landmarks that are too close."""
    vector = _mean(direction.end, points) - _mean(direction.start, points)
    length = np.linalg.norm(vector)
    if length < MIN_LENGTH_MM:
        raise DataError(
            f'the landmarks {", ".join((*direction.start, *direction.end))} of the '
            f'{direction.axis} axis are {length:g} mm apart'
        )
    sign = -1 if direction.lateral and side == 'left' else 1
    return sign * vector / length


# Conventions of joints: sequences of rotations, and the clinical names of their signs.
#
# A joint coordinate system after Grood and Suntay (1983) is a Cardan sequence: the first axis is
# fixed in the proximal bone, the third one in the distal bone, and the second (floating) axis is
# perpendicular to both. R = R_i(1) R_j(2) R_k(3) maps distal to proximal axes (sources above).


@dataclass(frozen=True)
class Convention:
    """Convention that expresses the motion of a joint."""

    name: str
    sequence: str  #: axes of the rotations, such as 'zxy'
    #: names that state the positive direction
    angles: tuple[str, str, str]
    translations: tuple[str, str, str]
    #: signs of the named quantities for a right limb
    angle_signs: tuple[int, int, int] = (1, 1, 1)
    translation_signs: tuple[int, int, int] = (1, 1, 1)
    #: index of the axis that points to the right of the person, along which a left limb is
    #: mirrored; None if sides do not differ
    lateral: int | None = None
    #: True: translations are along the three axes of rotation; False: along x, y and z of the
    #: proximal frame
    along_axes: bool = True
    branch: int = 1  #: sign of the second angle of an Euler sequence
    #: kinds of landmark frames; empty if there are none
    proximal_landmarks: str = ''
    distal_landmarks: str = ''
    origins_meet: bool = False  #: whether both origins are at the joint
    hinge: bool = False  #: whether the joint mainly rotates about its first axis
    #: least and largest value of each angle [deg] that no joint exceeds
    limits_deg: tuple[tuple[float, float], ...] = ((-np.inf, np.inf),) * 3

    @property
    def is_euler(self) -> bool:
        """Whether the first and the third axis have the same name."""
        return self.sequence[0] == self.sequence[2]

    def mirror(self, side: str) -> NDArray[np.float64]:
        """Return the matrix (3, 3) that mirrors a limb of this side to a right limb."""
        matrix = np.eye(3)
        if side == 'left' and self.lateral is not None:
            matrix[self.lateral, self.lateral] = -1
        return matrix

    def check_side(self, side: str) -> None:
        """Raise DataError for an invalid side, or a missing one if it matters."""
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


# Limits of angles [deg] that the most mobile persons do not reach. A hinge bends backwards by less
# than 30 degrees (a hyperextension of 10 is normal, one of 20 rare). Axes of two bones that point
# to opposite sides are 90 degrees apart or more.
_HINGE = (-30.0, 180.0)
_SAME_SIDE = (-90.0, 90.0)
_FREE = (-np.inf, np.inf)


def _isb(
    name: str,
    angles: str,
    translations: str,
    landmarks: tuple[str, str],
    limits: tuple[tuple[float, float], ...],
) -> Convention:
    """Return an ISB convention: flexion about z, floating axis x, rotation about y."""
    proximal, distal = landmarks
    first, second, third = angles.split()
    lateral, anterior, axial = translations.split()
    return Convention(
        name,
        'zxy',
        angles=(first, second, third),
        translations=(lateral, anterior, axial),
        lateral=2,
        proximal_landmarks=proximal,
        distal_landmarks=distal,
        origins_meet=name in ('isb_hip', 'isb_ankle'),
        limits_deg=limits,
    )


# Elevation is the negative rotation about x, in a plane rotated about y.
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
    origins_meet=True,
)
_SHIFTS = 'lateral_shift anterior_shift proximal_shift'
_CLINICAL = (
    # Flexion rotates the distal end of the tibia backwards, against the right-hand rule about x.
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
        origins_meet=True,
        hinge=True,
        limits_deg=(_HINGE, _SAME_SIDE, _SAME_SIDE),
    ),
    _isb(
        'isb_hip',
        'flexion adduction internal_rotation',
        _SHIFTS,
        ('pelvis_isb', 'femur_isb'),
        ((-90.0, 180.0), _SAME_SIDE, _SAME_SIDE),
    ),
    # The frame of the calcaneus is that of the tibia in neutral position.
    _isb(
        'isb_ankle',
        'dorsiflexion inversion internal_rotation',
        'lateral_shift anterior_shift compression',
        ('tibia_isb', ''),
        (_SAME_SIDE,) * 3,
    ),
    _isb(
        'isb_elbow',
        'flexion adduction pronation',
        _SHIFTS,
        ('humerus_isb', 'forearm_isb'),
        (_HINGE, _SAME_SIDE, _FREE),
    ),
    _isb(
        'isb_wrist',
        'flexion ulnar_deviation pronation',
        'radial_shift volar_shift proximal_shift',
        ('radius_isb', 'metacarpal_isb'),
        ((-120.0, 120.0), _SAME_SIDE, _SAME_SIDE),
    ),
    _SHOULDER,
    replace(
        _SHOULDER,
        name='isb_thoracohumeral',
        proximal_landmarks='thorax_isb',
        origins_meet=False,
    ),
)

CONVENTIONS = {one.name: one for one in (*_sequences(), *_CLINICAL)}


def convention(name: str) -> Convention:
    """Return the convention of a given name. Raises DataError for an unknown name."""
    if name not in CONVENTIONS:
        raise DataError(
            f'the convention {name!r} is unknown, expected one of {", ".join(CONVENTIONS)}'
        )
    return CONVENTIONS[name]
