# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The record of a calibration: every value that its file, its message and its id contain.

Each value is declared once, by a `Field`. The arrays of a file and their limits, the defaults for
files of earlier versions, the fields of a message and the table in the documentation follow from
this declaration.

To add a value, add one line here and an attribute to `FluoroscopeCalibration`. Values that
determine a correction come first, in the order in which they enter the id.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from ..exposures.frame import MAX_ANGLE
from ..limits import MAX_ANGLES, MAX_IMAGE_SIDE, MAX_NEIGHBOURS, MAX_PRINCIPAL_DISTANCE_PX, MAX_PX
from .terms import CUBIC, QUINTIC, polynomial_powers


@dataclass(frozen=True)
class Field:
    """A value of a record."""

    name: str
    dtype: str  #: {'text', 'int', 'float', 'bool'}
    shape: tuple[int | str, ...] = ()  #: a letter stands for any length
    #: unit and meaning, for the documentation
    unit: str = '-'
    meaning: str = ''
    minimum: float | None = None
    maximum: float | None = None  #: maximum of the absolute value of finite numbers
    longest: int | None = None  #: maximum length that a letter can stand for
    #: lengths other than 0 that a letter of the shape can stand for
    lengths: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    allowed: str = ''  #: value that a float can have besides finite ones: {'', 'inf', 'nan'}
    since: int = 1  #: first version of the file that has the field
    before: Any = None  #: value assumed for a record of an earlier version
    #: fields of the message; several contain the parts along the axis of that length; empty: the
    #: field of the same name
    message: tuple[str, ...] = ()
    #: dependence of the record's identifier on the field: {'', 'correction', 'detail'};
    #: 'correction' if the field determines a correction, 'detail' if it does not
    identity: str = ''


VERSION = 4  # version of the file format
MAX_DEGREE = 15  # maximum degree of a series on reading
MAX_MODES = 100  # maximum number of modes of a series on reading
SD_GRID = 33  # nodes of the standard deviation along each side of the image
ORDERS = 2  # number of harmonics of the angle
HARMONICS = 2 * ORDERS
DEGREES = (CUBIC, QUINTIC)  # degrees of the polynomials that a harmonic of the angle adds
TERMS = tuple(len(polynomial_powers(degree)) for degree in DEGREES)
VARIANCES = HARMONICS + HARMONICS * (HARMONICS + 1) // 2  # with the series, and of each pair

_correction = partial(Field, identity='correction')
_detail = partial(Field, identity='detail')


def _pixels(name: str, meaning: str, shape: tuple[int | str, ...] = (), **more: Any) -> Field:
    """Declare lengths in the image that determine a correction."""
    return _correction(name, 'float', shape, 'px', meaning, maximum=MAX_PX, **more)


def _count(name: str, meaning: str, shape: tuple[int | str, ...] = (), **more: Any) -> Field:
    """Declare counts, which do not affect a correction."""
    return _detail(name, 'int', shape, '1', meaning, minimum=0, **more)


def _fit(name: str, meaning: str, allowed: str, **more: Any) -> Field:
    """Declare a dimensionless measure of how well an adjustment fits."""
    return _detail(name, 'float', (), '1', meaning, allowed=allowed, **more)


FIELDS = (
    # Values that determine a correction.
    _correction(
        'fluoroscope',
        'text',
        meaning='name of the fluoroscope: letters, digits, `_` and `-`; part of the file name',
    ),
    _correction(
        'interior',
        'float',
        (3,),
        'px',
        'interior orientation: xp, yp (principal point), c (principal distance)',
        maximum=MAX_PRINCIPAL_DISTANCE_PX,
        message=('xp', 'yp', 'c'),
    ),
    _correction(
        'image_size',
        'int',
        (2,),
        'px',
        'width and height of the image',
        minimum=1,
        maximum=MAX_IMAGE_SIDE,
        message=('image_width', 'image_height'),
    ),
    _pixels(
        'train_uv',
        'observed u, v of each training point',
        ('N', 2),
        message=('train_u', 'train_v'),
    ),
    _pixels(
        'train_duv',
        'correction du, dv at each training point',
        ('N', 2),
        message=('train_du', 'train_dv'),
    ),
    _correction(
        'model_k',
        'int',
        (),
        '1',
        'number of neighbours of the model; 0 for a model without neighbours',
        minimum=0,
        maximum=MAX_NEIGHBOURS,
        message=('k',),
    ),
    _pixels(
        'noise_px',
        'standard deviation of a single training correction',
        minimum=0,
        message=('model_noise',),
    ),
    _pixels(
        'bias_px', 'systematic error of a predicted correction', minimum=0, message=('model_bias',)
    ),
    _pixels(
        'image_sd',
        "standard deviation of an inlier's image coordinate, with what the distortion of single "
        'exposures differs; for points without sigma',
        minimum=0,
    ),
    _correction(
        'sigma0',
        'float',
        (),
        'px, or 1',
        'scale of the Student-t noise; a factor on sigma where sigma was given',
        minimum=0,
        maximum=MAX_PX,
    ),
    _correction(
        'series_degree',
        'int',
        (),
        '1',
        'degree of the polynomials of the series; -1: the model has no series',
        minimum=-1,
        maximum=MAX_DEGREE,
        since=2,
        before=np.array(-1),
    ),
    _correction(
        'series_modes',
        'int',
        (),
        '1',
        'number of sines along the longer side of the image; 0: polynomials only',
        minimum=0,
        maximum=MAX_MODES,
        since=2,
        before=np.array(0),
    ),
    _pixels(
        'series_coefficients',
        'coefficients in u and in v; M = 0 without a series',
        (2, 'M'),
        since=2,
        before=np.zeros((2, 0)),
        message=('series_u', 'series_v'),
    ),
    _pixels(
        'series_sd',
        f'standard deviation of the series on a grid from edge to edge of the image, row by row, '
        f'S = {SD_GRID}; (0, 0) without a series',
        ('S', 'S'),
        minimum=0,
        lengths={'S': (SD_GRID,)},
        since=2,
        before=np.zeros((0, 0)),
    ),
    _correction(
        'angles',
        'float',
        ('A',),
        'rad',
        'angles of the C-arm in the exposures; A = 0: the correction does not depend on the angle',
        maximum=MAX_ANGLE,
        longest=MAX_ANGLES,
        since=3,
        before=np.zeros(0),
    ),
    _pixels(
        'angle_coefficients',
        'coefficients in u and v of what each harmonic of the angle adds, '
        f'H = {HARMONICS}, T = {TERMS[0]} or {TERMS[1]}; (0, 2, 0) without angles',
        ('H', 2, 'T'),
        lengths={'H': (HARMONICS,), 'T': TERMS},
        since=3,
        before=np.zeros((0, 2, 0)),
    ),
    _correction(
        'angle_variances',
        'float',
        ('V', 'G', 'G'),
        'px²',
        'covariances of these fields on the grid of `series_sd`, '
        f'V = {VARIANCES}, G = {SD_GRID}; (0, 0, 0) without angles',
        maximum=MAX_PX**2,
        lengths={'V': (VARIANCES,), 'G': (SD_GRID,)},
        since=3,
        before=np.zeros((0, 0, 0)),
    ),
    _correction(
        'noise_profile',
        'float',
        ('P',),
        '-',
        'factors f0, f1 of `image_sd` in the middle of the image, and at the border and beyond, '
        'and the distance r of the border from the middle in halves of the longer side, P = 3; '
        'P = 0: the same everywhere',
        minimum=0,
        maximum=MAX_PX,
        longest=3,
        since=4,
        before=np.zeros(0),
    ),
    _correction(
        'model_kind',
        'text',
        meaning='kind of correction model: `knn`, `local_linear`, `parametric`, `hybrid`, '
        '`collocation`, `none`, `lookup`',
    ),
    _correction(
        'source_digest',
        'text',
        meaning='SHA-256 of the observations and the phantom',
    ),
    # Values that do not affect a correction.
    _detail(
        'interior_covariance',
        'float',
        (3, 3),
        'px²',
        'covariance of xp, yp, c; zeros if the interior orientation was fixed',
        maximum=MAX_PRINCIPAL_DISTANCE_PX**2,
    ),
    _count('train_exposure', 'number of the exposure of each training point', ('N',)),
    _detail(
        'rmse_before',
        'float',
        (2,),
        'px',
        'RMSE of the inlier residuals in u, v without correction; NaN: no inliers',
        minimum=0,
        allowed='nan',
        message=('rmse_before_u', 'rmse_before_v'),
    ),
    _detail(
        'rmse_after',
        'float',
        (2,),
        'px',
        'the same with the correction',
        minimum=0,
        allowed='nan',
        message=('rmse_after_u', 'rmse_after_v'),
    ),
    _fit('nu', 'degrees of freedom of that noise; `inf`: Gaussian', 'inf', minimum=0),
    _fit(
        'cost_adjustment',
        'F, final negative log-likelihood of the image points; may be NaN',
        'nan',
    ),
    _fit(
        'cost_regression',
        'G, final weighted sum of squares of the cross-validation; may be NaN',
        'nan',
    ),
    _detail(
        'interior_estimated',
        'bool',
        meaning='true: estimated in the adjustment; false: fixed, the correction model learned it',
    ),
    _count('exposures', 'number of exposures used'),
    _count('observations', 'number of image points used'),
    _count('inliers', 'number of image points that the adjustment classified as inliers'),
    _count('iterations', 'number of rounds of adjustment and regression'),
    _detail('converged', 'bool', meaning='false: stopped at the maximum number of rounds'),
    # Values that do not enter the id. Files of observations contain neither stamps nor frame ids,
    # so a calibration from files has the same id as the equal calibration by the node.
    Field(
        'calibration_id',
        'text',
        meaning='identifier of the calibration; derived from the content and verified on reading; '
        'that of an earlier version, of what determines a correction only, is replaced by it',
    ),
    Field(
        'stamp_ns',
        'int',
        (),
        'ns',
        'time of the last exposure used, since 1970',
        message=('header.stamp',),
    ),
    Field(
        'frame_id',
        'text',
        meaning='optical frame of the fluoroscope in ROS',
        message=('header.frame_id',),
    ),
)
