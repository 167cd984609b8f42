"""Calibration of one fluoroscope: what is published, saved and used for the correction."""

import hashlib
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ..distortion.base import CorrectionModel
from ..distortion.grid import CorrectionGrid
from ..distortion.series import packed
from ..distortion.status import CorrectionStatus
from ..exposures.frame import points_on_image


@dataclass(frozen=True)
class CorrectedPoints:
    """Corrected image points: uv (n, 2) [px], sigma (n,) [px] of each coordinate, status (n,) OK,
    OUTSIDE or INVALID. Where the status is INVALID, uv and sigma are NaN.
    """

    uv: np.ndarray
    sigma: np.ndarray
    status: np.ndarray


@dataclass(frozen=True)
class FluoroscopeCalibration:
    """Interior orientation and correction model of one fluoroscope, with the figures of their
    quality.

    interior (3,) xp, yp, c and interior_covariance (3, 3) [px]; image_size (width, height) [px];
    image_sd: standard deviation of an image coordinate of an inlier [px]; sigma0 and nu: scale and
    degrees of freedom of the Student-t noise, sigma0 a factor of sigma where that was given;
    rmse_before and rmse_after (2,) of the inlier residuals [px]; cost_adjustment F and
    cost_regression G; stamp_ns of the last exposure used; seconds the calibration took, NaN where
    it was read from a file; source_digest of observations and phantom. calibration_id follows from
    the content.
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
        for array in (
            self.interior,
            self.image_size,
            self.model.train_uv,
            self.model.train_duv,
            [self.model.k, self.model.noise_px, self.model.bias_px, self.image_sd, self.sigma0],
        ):
            digest.update(np.ascontiguousarray(array, dtype=float).tobytes())
        if self.model.series is not None:
            degree, modes, coefficients, sd = packed(self.model.series)
            digest.update(
                np.concatenate([[degree, modes], coefficients.ravel(), sd.ravel()]).tobytes()
            )
        digest.update(f'{self.fluoroscope}/{self.model.kind}/{self.source_digest}'.encode())
        object.__setattr__(self, 'calibration_id', f'{self.fluoroscope}-{digest.hexdigest()[:16]}')

    @cached_property
    def grid(self):
        """The CorrectionGrid that answers for the model; it is built when it is first asked for."""
        return CorrectionGrid(self.model, self.image_size)

    def prepare(self):
        """Build what the first correction needs, so that no frame waits for it."""
        self.grid

    def correct(self, uv, sigma=None, exact=False):
        """Corrected image points of observed pixels uv (n, 2); sigma (n,) of them, None: that of
        the calibration.

        Standard deviations are those of observation and correction together. exact: from the model
        itself and not from its grid, which differs by grid.error_px and tells OUTSIDE up to a cell
        before the calibrated area ends.
        """
        uv = np.asarray(uv, dtype=float).reshape(-1, 2)
        sigma = None if sigma is None else np.asarray(sigma, dtype=float)
        if exact:
            return self._correct_exactly(uv, self.image_sd if sigma is None else sigma)
        u, v, sigma, _, status = self.correct_arrays(uv[:, 0], uv[:, 1], sigma)
        return CorrectedPoints(np.stack([u, v], axis=1), sigma, status)

    def correct_arrays(self, u, v, sigma=None):
        """The same for arrays u, v and sigma (n,) of floats: corrected u and v (n,) [px], sigma
        (n,) [px], that of the correction alone (n,) [px] and status (n,). The numbers are those of
        `correct`, and nothing is done that a frame of few points would wait for.
        """
        (du, dv, sd), status = self.grid.look_up(u, v)
        np.subtract(u, du, out=du)
        np.subtract(v, dv, out=dv)
        total = sd * sd
        total += self.image_sd**2 if sigma is None else sigma * sigma
        return du, dv, np.sqrt(total, out=total), sd, status

    def _correct_exactly(self, uv, sigma):
        good = points_on_image(uv, self.image_size)
        out = CorrectedPoints(
            np.full(uv.shape, np.nan),
            np.full(len(uv), np.nan),
            np.full(len(uv), CorrectionStatus.INVALID, dtype=np.uint8),
        )
        correction = self.model.evaluate(uv[good])
        out.uv[good] = uv[good] - correction.duv
        out.sigma[good] = np.sqrt(np.broadcast_to(sigma, len(uv))[good] ** 2 + correction.sd**2)
        out.status[good] = np.where(
            correction.outside, CorrectionStatus.OUTSIDE, CorrectionStatus.OK
        )
        return out


def digest_of_sources(frames, phantom):
    """SHA-256 (hex) of the frames of one fluoroscope and of the phantom."""
    digest = hashlib.sha256()
    for frame in sorted(frames, key=lambda f: f.number):
        frame = frame.sorted()
        digest.update(np.array([frame.number, *frame.image_size], dtype=np.int64).tobytes())
        digest.update(frame.target_id.astype(np.int64).tobytes() + frame.uv.tobytes())
        digest.update(b'' if frame.sigma is None else frame.sigma.tobytes())
    digest.update(
        phantom.target_id.astype(np.int64).tobytes()
        + phantom.xyz_mm.tobytes()
        + phantom.sd_mm.tobytes()
    )
    return digest.hexdigest()
