# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibration of one fluoroscope: published, saved, and used to correct image points.

The noise of image coordinates may differ between the middle of the image and its border. The
logarithm of the variance is a linear function of the squared distance from the middle:
multiplicative heteroscedasticity (Harvey, Econometrica 44, 1976).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..brief import brief_repr
from ..errors import DataError
from ..exposures.frame import Frame, points_on_image
from ..exposures.phantom import Phantom
from .angle_field import AngleField, packed_angles, unpacked_angles
from .base import Correction, CorrectionModel, CorrectionStatus
from .calibration_record import FIELDS, Field
from .grid import CorrectionGrid
from .registry import MODEL_FIELDS, model_from_values, no_correction
from .series import SERIES_FIELDS, Functions, Series

MAX_FACTOR = 10.0  # maximum estimated ratio of the factors of border and middle, or of its inverse


@dataclass(frozen=True)
class NoiseProfile:
    """Factors of the standard deviation of image coordinates as a function of the position."""

    #: factors in the middle of the image, and at the border and beyond; the mean of their squares
    #: over the image points is 1
    middle: float
    rim: float
    #: distance of the border from the middle, in units of half the longer side; there were no
    #: image points beyond it
    reach: float

    def factors(
        self, u: NDArray[np.float64], v: NDArray[np.float64], image_size: tuple[int, int]
    ) -> NDArray[np.float64]:
        """Return the factors (n,) at pixels u, v (n,)."""
        square = np.minimum(square_distance(u, v, image_size), self.reach**2)
        square *= math.log(self.rim / self.middle) / self.reach**2
        return self.middle * np.exp(square)


def packed_profile(profile: NoiseProfile | None) -> NDArray[np.float64]:
    """Return middle, border and reach (3,) of a profile for files and messages; (0,) for None."""
    if profile is None:
        return np.zeros(0)
    return np.array([profile.middle, profile.rim, profile.reach])


def unpacked_profile(values: np.ndarray) -> NoiseProfile | None:
    """Return the profile that `packed_profile` turned into an array.

    Raises ValueError for arrays of another length and for implausible factors.
    """
    if not len(values):
        return None
    if len(values) != 3:
        raise ValueError(f'its noise profile has {len(values)} values, 3 are expected')
    middle, rim, reach = np.asarray(values, dtype=float).tolist()
    valid = min(middle, rim, reach) > 0 and max(middle, rim, reach) < np.inf
    if not valid or not 1 / MAX_FACTOR**2 < middle / rim < MAX_FACTOR**2:
        raise ValueError('its noise profile has factors that no image has')
    return NoiseProfile(middle, rim, reach)


def square_distance(
    u: NDArray[np.float64], v: NDArray[np.float64], image_size: tuple[int, int]
) -> NDArray[np.float64]:
    """Return squared distances (n,) from the image centre, in units of half the longer side."""
    width, height = image_size
    half = max(width, height) / 2
    x = (u - (width - 1) / 2) / half
    y = (v - (height - 1) / 2) / half
    with np.errstate(over='ignore'):  # such pixels are off every image
        x *= x
        y *= y
        x += y
    return x


_ANGLES = ('angles', 'angle_coefficients', 'angle_variances')


@dataclass(frozen=True)
class CorrectedPoints:
    """Corrected image points.

    uv (n, 2) [px]; sigma (n,): standard deviation of each coordinate [px]; status (n,):
    `CorrectionStatus`. uv and sigma are NaN where the status is INVALID.
    """

    __repr__ = brief_repr

    uv: NDArray[np.float64]
    sigma: NDArray[np.float64]
    status: NDArray[np.uint8]


@dataclass(frozen=True)
class FluoroscopeCalibration:
    """Interior orientation and correction model of one fluoroscope, and their quality.

    The meaning and unit of most attributes are in `calibration_record`. The following attributes
    are not fields of the record.

    Attributes
    ----------
    model : CorrectionModel
    angle_field : AngleField or None
        Change of the correction with the angle of the C-arm; None if it does not change.
    noise_profile : NoiseProfile or None
        Factors of image_sd over the image; None if it is the same everywhere.
    seconds : float
        Duration of the calibration; NaN for a calibration read from a file.
    """

    __repr__ = brief_repr

    fluoroscope: str
    image_size: tuple[int, int]
    interior: NDArray[np.float64]
    interior_covariance: NDArray[np.float64]
    interior_estimated: bool
    model: CorrectionModel
    train_exposure: NDArray[np.int64]
    image_sd: float
    sigma0: float
    nu: float
    exposures: int
    observations: int
    inliers: int
    rmse_before: NDArray[np.float64]
    rmse_after: np.ndarray
    cost_adjustment: float
    cost_regression: float
    iterations: int
    converged: bool
    stamp_ns: int
    frame_id: str
    source_digest: str
    angle_field: AngleField | None = None
    noise_profile: NoiseProfile | None = None
    seconds: float = field(default=np.nan, compare=False)
    calibration_id: str = field(init=False)

    def __post_init__(self) -> None:
        digest = hashlib.sha256()
        self._add_to(digest, 'correction')
        self._add_to(digest, 'detail')
        object.__setattr__(self, 'calibration_id', self._identity(digest))

    @property
    def earlier_id(self) -> str:
        """Id of this calibration in earlier versions, from the fields of the correction only."""
        digest = hashlib.sha256()
        self._add_to(digest, 'correction')
        return self._identity(digest)

    def _identity(self, digest: hashlib._Hash) -> str:
        return f'{self.fluoroscope}-{digest.hexdigest()[:16]}'

    def _add_to(self, digest: hashlib._Hash, identity: str) -> None:
        """Add the fields with this identity to a digest: arrays of numbers, then words.

        The words of a correction are its text fields; the words of its details are its scalar
        integers and booleans.
        """
        fields = [field for field in FIELDS if field.identity == identity]
        values = self.to_values(fields)
        words = []
        for entry in fields:
            value = values[entry.name]
            if entry.name in SERIES_FIELDS and self.model.series is None:
                continue
            if entry.dtype == 'text':
                words.append(value)
            elif identity == 'detail' and entry.dtype != 'float' and not entry.shape:
                words.append(str(int(value)))
            else:
                numbers = np.ascontiguousarray(value, dtype=float)
                digest.update(np.where(np.isnan(numbers), np.nan, numbers).tobytes())
        digest.update('/'.join(words).encode())

    def to_values(self, fields: Sequence[Field] = FIELDS) -> dict[str, Any]:
        """Return the values of fields of the record, for files and messages."""
        values = self.model.to_values()
        values |= zip(_ANGLES, packed_angles(self.angle_field))
        values['noise_profile'] = packed_profile(self.noise_profile)
        # An empty list would become an array of floats.
        values['train_exposure'] = np.asarray(
            self.train_exposure, dtype=None if len(self.train_exposure) else np.int64
        )
        return {
            field.name: values[field.name] if field.name in values else getattr(self, field.name)
            for field in fields
        }

    @classmethod
    def from_values(
        cls, values: Mapping[str, Any], seconds: float = np.nan
    ) -> FluoroscopeCalibration:
        """Return the calibration from which `to_values` made the values; its id is computed anew.

        Raises ValueError for values that do not match.
        """
        width, height = (int(side) for side in values['image_size'])
        size = (width, height)
        packed = {'calibration_id', 'image_size', 'noise_profile', *_ANGLES, *MODEL_FIELDS}
        return cls(
            image_size=size,
            model=model_from_values(values, size),
            angle_field=unpacked_angles(size, *(values[name] for name in _ANGLES)),
            noise_profile=unpacked_profile(values['noise_profile']),
            seconds=seconds,
            **{field.name: values[field.name] for field in FIELDS if field.name not in packed},
        )

    def noise_factors(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the factors (n,) of image_sd at pixels uv (n, 2)."""
        if self.noise_profile is None:
            return np.ones(len(uv))
        return self.noise_profile.factors(uv[:, 0], uv[:, 1], self.image_size)

    def image_sd_at(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the standard deviations (n,) [px] of image coordinates at pixels uv (n, 2)."""
        return self.image_sd * self.noise_factors(uv)

    def noise_sd(self, frame: Frame) -> NDArray[np.float64]:
        """Return the standard deviations (n,) [px] of the image coordinates of a frame."""
        if frame.sigma is None:
            return self.image_sd_at(frame.uv)
        return self.sigma0 * np.asarray(frame.sigma)

    @cached_property
    def grid(self) -> CorrectionGrid:
        """Lookup grid of the model, built on first use."""
        return CorrectionGrid(self.model, self.image_size)

    def prepare(self) -> None:
        """Build what the first correction needs, so that no frame has to wait for it."""
        _ = self.grid

    def correction(self, uv: ArrayLike, angle: ArrayLike | None = None) -> Correction:
        """Return the Correction of the model at pixels uv (n, 2).

        angle: angle of the C-arm [rad], a number or (n,); None or NaN where it is unknown.
        """
        correction = self.model.evaluate(uv)
        if self.angle_field is None:
            return correction
        angle = np.nan if angle is None else angle
        duv, variance = self.angle_field.change(uv, angle)
        return Correction(
            correction.duv + duv,
            np.sqrt(np.maximum(correction.sd**2 + variance, 0)),
            correction.outside | ~self.angle_field.covers(angle),
        )

    def at_angle(self, angle: float | None) -> FluoroscopeCalibration:
        """Return the calibration at a fixed angle [rad] of the C-arm.

        Returns self if the angle is None or the calibration does not depend on it. Raises
        DataError for an angle outside the calibrated range.
        """
        field = self.angle_field
        series = self.model.series
        if field is None or angle is None or series is None:
            return self
        if not field.covers(angle):
            low, high = np.degrees(field.range)
            raise DataError(
                f'fluoroscope {self.fluoroscope}: {np.degrees(angle):g} degrees is too far from '
                f'the angles of the calibration, {low:.0f} to {high:.0f} degrees'
            )
        model = replace(
            self.model,
            train_duv=self.model.train_duv + field.change(self.model.train_uv, angle)[0],
            series=field.added_to(series, angle),
        )
        return replace(self, model=model, angle_field=None)

    def correct(
        self,
        uv: ArrayLike,
        sigma: ArrayLike | None = None,
        exact: bool = False,
        angle: ArrayLike | None = None,
    ) -> CorrectedPoints:
        """Return the corrected image points of observed pixels.

        Parameters
        ----------
        uv : (n, 2) array_like
            Observed pixels.
        sigma : (n,) array_like, optional
            Their standard deviations [px]; by default those of the calibration.
        exact : bool
            True to evaluate the model itself instead of its grid. The grid differs from it by up
            to grid.error_px and reports OUTSIDE up to a cell before the calibrated area ends.
        angle : float or (n,) array_like, optional
            Angle of the C-arm [rad], if the correction changes with it; None or NaN if unknown.

        Returns
        -------
        CorrectedPoints
            Their standard deviations combine those of observation and correction.
        """
        uv = np.asarray(uv, dtype=float).reshape(-1, 2)
        sigma = None if sigma is None else np.asarray(sigma, dtype=float)
        if exact:
            return self._correct_exactly(
                uv, self.image_sd_at(uv) if sigma is None else sigma, angle
            )
        u, v, total, _, status = self.correct_arrays(uv[:, 0], uv[:, 1], sigma, angle)
        return CorrectedPoints(np.stack([u, v], axis=1), total, status)

    def correct_arrays(
        self,
        u: NDArray[np.float64],
        v: NDArray[np.float64],
        sigma: NDArray[np.float64] | None = None,
        angle: ArrayLike | None = None,
    ) -> tuple[
        NDArray[np.float64],
        NDArray[np.float64],
        NDArray[np.float64],
        NDArray[np.float64],
        NDArray[np.uint8],
    ]:
        """Correct arrays u, v and sigma (n,) of floats with the least overhead.

        angle: angle of the C-arm [rad], a number or (n,); None or NaN where it is unknown. Returns
        corrected u and v, their standard deviation, the standard deviation of the correction alone
        [px], and status, each (n,). The values are equal to those of `correct`.
        """
        (du, dv, sd), status = self.grid.look_up(u, v)
        if self.angle_field is not None:
            self._add_angle(self.angle_field, (u, v), (du, dv, sd), status, angle)
        np.subtract(u, du, out=du)
        np.subtract(v, dv, out=dv)
        total = sd * sd
        if sigma is not None:
            total += sigma * sigma
        elif self.noise_profile is None:
            total += self.image_sd**2
        else:
            noise = self.image_sd * self.noise_profile.factors(u, v, self.image_size)
            noise *= noise
            total += noise
        return du, dv, np.sqrt(total, out=total), sd, status

    @staticmethod
    def _add_angle(
        field: AngleField,
        uv: tuple[NDArray[np.float64], NDArray[np.float64]],
        correction: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
        status: NDArray[np.uint8],
        angle: ArrayLike | None,
    ) -> None:
        """Add the change with the angle to a correction and its status, in place."""
        valid = status != int(CorrectionStatus.INVALID)
        valid_rows = slice(None) if valid.all() else np.flatnonzero(valid)
        angle = np.asarray(np.nan if angle is None else angle, dtype=float)
        angle = angle[valid_rows] if angle.ndim else angle
        duv, variance = field.change(
            np.column_stack([uv[0][valid_rows], uv[1][valid_rows]]), angle
        )
        du, dv, sd = correction
        du[valid_rows] += duv[:, 0]
        dv[valid_rows] += duv[:, 1]
        sd[valid_rows] = np.sqrt(np.maximum(sd[valid_rows] ** 2 + variance, 0))
        outside = ~field.covers(angle)
        if outside.any():
            status[valid_rows] = np.where(outside, CorrectionStatus.OUTSIDE, status[valid_rows])

    def _correct_exactly(
        self, uv: NDArray[np.float64], sigma: NDArray[np.float64] | float, angle: ArrayLike | None
    ) -> CorrectedPoints:
        """Correct points with the model itself."""
        valid = points_on_image(uv, self.image_size)
        correction = self.correction(np.where(valid[:, None], uv, 0.0), angle)
        status = np.where(correction.outside, CorrectionStatus.OUTSIDE, CorrectionStatus.OK)
        return CorrectedPoints(
            np.where(valid[:, None], uv - correction.duv, np.nan),
            np.where(valid, np.sqrt(np.square(sigma) + correction.sd**2), np.nan),
            np.where(valid, status, CorrectionStatus.INVALID).astype(np.uint8),
        )


def with_drift(
    calibration: FluoroscopeCalibration,
    drift: Functions,
    coefficients: NDArray[np.float64],
    sd: NDArray[np.float64],
) -> FluoroscopeCalibration:
    """Return a calibration with a change added to its correction.

    drift, coefficients (2, n) [px]: functions of the change and their coefficients. sd (33, 33):
    standard deviation of the change, on the grid of `Series`. Raises DataError for a model without
    a series, which has no field of standard deviations.
    """
    model = calibration.model
    if model.series is None:
        raise DataError(
            f'fluoroscope {calibration.fluoroscope}: the model {model.kind} has no field of '
            'standard deviations, a change of the distortion cannot be added to it'
        )
    change = Series(drift, coefficients, sd)
    changed = replace(
        model,
        train_duv=model.train_duv + change.predict(model.train_uv),
        series=model.series.plus(change),
    )
    return replace(calibration, model=changed)


def with_larger_sd(
    calibration: FluoroscopeCalibration, sd: NDArray[np.float64]
) -> FluoroscopeCalibration:
    """Return a calibration whose correction has a standard deviation of at least sd (33, 33).

    sd is on the grid of `Series` [px]. A model without a series is returned unchanged, as it has
    no field of standard deviations.
    """
    series = calibration.model.series
    if series is None or (sd <= series.sd).all():
        return calibration
    model = replace(calibration.model, series=replace(series, sd=np.maximum(series.sd, sd)))
    return replace(calibration, model=model)


def at_common_angle(
    uv: ArrayLike, one: FluoroscopeCalibration, other: FluoroscopeCalibration
) -> tuple[Correction, Correction]:
    """Return the corrections of two calibrations at pixels uv (n, 2), for comparison.

    If both change with the angle of the C-arm, they are evaluated at the same angle: the exposure
    angle of the first that is nearest to an angle of the second.
    """
    fields = (one.angle_field, other.angle_field)
    angle = None
    if fields[0] is not None and fields[1] is not None:
        angle = fields[0].nearest_common(fields[1])
    return one.correction(uv, angle), other.correction(uv, angle)


def digest_of_sources(frames: Iterable[Frame], phantom: Phantom) -> str:
    """Return the SHA-256 (hex) of the frames of one fluoroscope and of the phantom."""
    digest = hashlib.sha256()
    for frame in sorted(frames, key=lambda f: f.number):
        frame = frame.sorted()
        digest.update(np.array([frame.number, *frame.image_size], dtype=np.int64).tobytes())
        digest.update(frame.target_id.astype(np.int64).tobytes() + frame.uv.tobytes())
        digest.update(b'' if frame.sigma is None else frame.sigma.tobytes())
        digest.update(b'' if frame.angle is None else np.array([frame.angle]).tobytes())
    digest.update(
        phantom.target_id.astype(np.int64).tobytes()
        + phantom.xyz_mm.tobytes()
        + phantom.sd_mm.tobytes()
    )
    return digest.hexdigest()


Calibrations = Mapping[str, FluoroscopeCalibration]  # by name of the fluoroscope


def ids_of(calibrations: Calibrations) -> dict[str, str]:
    """Return the ids of calibrations by fluoroscope."""
    return {name: calibration.calibration_id for name, calibration in calibrations.items()}


def uncorrected(calibrations: Calibrations) -> dict[str, FluoroscopeCalibration]:
    """Return calibrations without corrections, to test for points that are already corrected."""
    return {
        name: replace(
            calibration,
            model=no_correction(),
            train_exposure=np.zeros(0, dtype=np.int64),
            angle_field=None,
        )
        for name, calibration in calibrations.items()
    }
