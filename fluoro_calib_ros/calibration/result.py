"""Calibration of one fluoroscope: what is published, saved and used for the correction."""

import hashlib
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ..distortion.models import CorrectionModel
from ..distortion.series import packed
from ..photogrammetry.observations import points_on_image

OK, OUTSIDE, INVALID = 0, 1, 2   # status of a corrected image point


@dataclass(frozen=True)
class CorrectedPoints:
    """Corrected image points: uv (n, 2) [px], sigma (n,) [px] of each coordinate, status (n,) OK, OUTSIDE or
    INVALID. Where the status is INVALID, uv and sigma are NaN."""

    uv: np.ndarray
    sigma: np.ndarray
    status: np.ndarray


@dataclass(frozen=True)
class FluoroscopeCalibration:
    """Interior orientation and correction model of one fluoroscope, with the figures of their quality.

    interior (3,) xp, yp, c and interior_covariance (3, 3) [px]; image_size (width, height) [px]; image_sd:
    standard deviation of an image coordinate of an inlier [px]; sigma0 and nu: scale and degrees of freedom of
    the Student-t noise, sigma0 a factor of sigma where that was given; rmse_before and rmse_after (2,) of the
    inlier residuals [px]; cost_adjustment F and cost_regression G;
    stamp_ns of the last exposure used; seconds the calibration took, NaN where it was
    read from a file; source_digest of observations and phantom. calibration_id follows from the content.
    """

    fluoroscope: str
    image_size: tuple
    interior: np.ndarray
    interior_covariance: np.ndarray
    interior_estimated: bool
    model: CorrectionModel
    train_exposure: np.ndarray
    image_sd: float
    sigma0: float
    nu: float
    exposures: int
    observations: int
    inliers: int
    rmse_before: np.ndarray
    rmse_after: np.ndarray
    cost_adjustment: float
    cost_regression: float
    iterations: int
    converged: bool
    stamp_ns: int
    frame_id: str
    source_digest: str
    seconds: float = field(default=np.nan, compare=False)
    calibration_id: str = field(init=False)

    def __post_init__(self):
        digest = hashlib.sha256()
        for array in (self.interior, self.image_size, self.model.train_uv, self.model.train_duv,
                      [self.model.k, self.model.noise_px, self.model.bias_px, self.image_sd, self.sigma0]):
            digest.update(np.ascontiguousarray(array, dtype=float).tobytes())
        if self.model.series is not None:
            degree, modes, coefficients, sd = packed(self.model.series)
            digest.update(np.concatenate([[degree, modes], coefficients.ravel(), sd.ravel()]).tobytes())
        digest.update(f'{self.fluoroscope}/{self.model.kind}/{self.source_digest}'.encode())
        object.__setattr__(self, 'calibration_id', f'{self.fluoroscope}-{digest.hexdigest()[:16]}')

    @cached_property
    def _frame_model(self):
        return self.model.at_frame_rate(self.image_size)

    def prepare(self):
        """Build what the first correction needs, so that no frame waits for it."""
        self._frame_model

    def correct(self, uv, sigma=None):
        """Corrected image points of observed pixels uv (n, 2); sigma (n,) of them, None: that of the calibration.

        Standard deviations are those of observation and correction together.
        """
        uv = np.asarray(uv, dtype=float).reshape(-1, 2)
        good = points_on_image(uv, self.image_size)
        out = CorrectedPoints(np.full(uv.shape, np.nan), np.full(len(uv), np.nan),
                              np.full(len(uv), INVALID, dtype=np.uint8))
        if not good.any():
            return out
        correction = self._frame_model.evaluate(uv[good])
        observed = self.image_sd if sigma is None else np.asarray(sigma, dtype=float)[good]
        out.uv[good] = uv[good] - correction.duv
        out.sigma[good] = np.sqrt(observed ** 2 + correction.sd ** 2)
        out.status[good] = np.where(correction.outside, OUTSIDE, OK)
        return out


def digest_of_sources(frames, phantom):
    """SHA-256 (hex) of the frames of one fluoroscope and of the phantom."""
    digest = hashlib.sha256()
    for frame in sorted(frames, key=lambda f: f.number):
        frame = frame.sorted()
        digest.update(np.array([frame.number, *frame.image_size], dtype=np.int64).tobytes())
        digest.update(frame.target_id.astype(np.int64).tobytes() + frame.uv.tobytes())
        digest.update(b'' if frame.sigma is None else frame.sigma.tobytes())
    digest.update(phantom.target_id.astype(np.int64).tobytes() + phantom.xyz_mm.tobytes() + phantom.sd_mm.tobytes())
    return digest.hexdigest()


__all__ = ['FluoroscopeCalibration', 'CorrectedPoints', 'digest_of_sources', 'OK', 'OUTSIDE', 'INVALID']
