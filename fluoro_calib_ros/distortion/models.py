"""Correction models behind one interface, with exact prediction."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from .series import Series
from .smoothers import KINDS, MIN_K, SMOOTHERS, Neighbourhoods
from .trend import Trend, least_squares_map

CHUNK = 2_000_000  # weights held at once, to bound the memory
SERIES_CHUNK = 20_000  # pixels for which a series is evaluated at once
SERIES = ('parametric', 'hybrid', 'collocation')  # the kinds that have one


@dataclass(frozen=True)
class Correction:
    """A correction at n pixels: duv (n, 2) [px], sd (n,) of each coordinate [px], outside (n,)
    True beyond the calibrated area.
    """

    duv: np.ndarray
    sd: np.ndarray
    outside: np.ndarray


@dataclass(frozen=True)
class CorrectionModel:
    """A correction model: (du, dv) as a function of the observed pixel.

    kind: one of KINDS; k neighbours, 0 for a kind without; train_uv (N, 2) observed pixels and
    train_duv (N, 2) corrections there [px]; noise_px: standard deviation of one training
    correction; bias_px: systematic error of a prediction; series: of parametric, hybrid and
    collocation, as it was adjusted. In local_linear a trend is fitted to the training corrections
    here. Raises ValueError for an unknown kind, a series too many or missing, or a k that the
    training points do not allow.
    """

    kind: str
    k: int
    train_uv: np.ndarray
    train_duv: np.ndarray
    noise_px: float = 0.0
    bias_px: float = 0.0
    series: Series | None = None
    tree: cKDTree = field(init=False, repr=False, compare=False)
    trend: Trend = field(init=False, repr=False, compare=False)
    trend_coefficients: np.ndarray = field(init=False, repr=False, compare=False)
    left: np.ndarray = field(init=False, repr=False, compare=False)
    _hull: np.ndarray = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        if self.kind not in KINDS:
            raise ValueError(f'correction model is one of {", ".join(KINDS)}, not {self.kind!r}')
        uv = np.ascontiguousarray(self.train_uv, dtype=float).reshape(-1, 2)
        duv = np.ascontiguousarray(self.train_duv, dtype=float).reshape(-1, 2)
        if len(uv) != len(duv):
            raise ValueError(f'{len(uv)} training points, but {len(duv)} corrections')
        if not (np.isfinite(uv).all() and np.isfinite(duv).all()):
            raise ValueError('a training point or its correction is not a number')
        if (self.series is not None) != (self.kind in SERIES):
            raise ValueError(
                f'{self.kind} and '
                + ('no series' if self.series is None else 'a series')
                + ' do not go together'
            )
        if self.kind in SMOOTHERS and not MIN_K[self.kind] <= self.k <= len(uv):
            raise ValueError(
                f'{self.kind} with k = {self.k} cannot be had from {len(uv)} training points'
            )
        object.__setattr__(self, 'train_uv', uv)
        object.__setattr__(self, 'train_duv', duv)
        object.__setattr__(self, 'tree', cKDTree(uv) if len(uv) else None)
        trend = Trend(self.kind, uv)
        basis = trend.basis(uv)
        coefficients = least_squares_map(basis) @ duv
        object.__setattr__(self, 'trend', trend)
        object.__setattr__(self, 'trend_coefficients', coefficients)
        left = duv - basis @ coefficients
        object.__setattr__(
            self, 'left', left if self.series is None else left - self.series.predict(uv)
        )
        object.__setattr__(self, '_hull', _half_planes(uv))

    def predict(self, uv):
        """Corrections (n, 2) [px] at pixels uv (n, 2)."""
        return self._evaluate(uv, with_sd=False)[0]

    def evaluate(self, uv):
        """Correction at pixels uv (n, 2), with standard deviations and what lies outside."""
        duv, norm2 = self._evaluate(uv, with_sd=True)
        return Correction(duv, self.sd(norm2, uv), self.outside(uv))

    def sd(self, norm2, uv):
        """Standard deviations (n,) [px] of predictions at pixels uv (n, 2), norm2 (n,) of their
        weights.
        """
        variance = self.noise_px**2 * norm2 + self.bias_px**2
        return np.sqrt(variance if self.series is None else variance + self.series.sd_at(uv) ** 2)

    def global_part(self, uv):
        """Trend or series (n, 2) [px] at pixels uv (n, 2)."""
        if self.series is None:
            return self.trend.basis(uv) @ self.trend_coefficients
        parts = range(0, len(uv), SERIES_CHUNK)
        return np.concatenate(
            [self.series.predict(uv[i : i + SERIES_CHUNK]) for i in parts] or [np.zeros((0, 2))]
        )

    def outside(self, uv):
        """True (n,) where a pixel (n, 2) lies beyond the convex hull of the training points."""
        uv = np.asarray(uv, dtype=float)
        if self.kind == 'none':
            return np.zeros(len(uv), dtype=bool)
        return (uv @ self._hull[:, :2].T + self._hull[:, 2] > 0).any(axis=1)

    def _evaluate(self, uv, with_sd):
        uv = np.asarray(uv, dtype=float).reshape(-1, 2)
        duv = np.zeros_like(uv)
        norm2 = np.zeros(len(uv))
        if self.kind == 'none':
            return duv, norm2
        if self.kind not in SMOOTHERS:
            return self.global_part(uv), norm2
        size = max(1, CHUNK // self.k)
        for start in range(0, len(uv), size):
            part = slice(start, start + size)
            index, weights = neighbours_and_weights(self.tree, self.kind, uv[part], self.k)
            duv[part] = np.einsum('nk,nkc->nc', weights, self.left[index])
            if with_sd:
                norm2[part] = np.einsum('nk,nk->n', weights, weights)
        return duv + self.global_part(uv), norm2


def neighbours_and_weights(tree, kind, uv, k):
    """Indices (n, k) of the nearest training points of pixels uv (n, 2), and their smoother
    weights (n, k).
    """
    _, index = tree.query(uv, k=np.arange(1, k + 1))
    return index, Neighbourhoods(tree.data[index], uv).weights(kind, k)


def no_correction():
    """The model that corrects nothing."""
    return CorrectionModel('none', 0, np.zeros((0, 2)), np.zeros((0, 2)))


def _half_planes(uv):
    """Half-planes (h, 3) whose intersection is the convex hull of uv (N, 2): a u + b v + c <= 0
    inside.
    """
    try:
        return ConvexHull(uv).equations
    except (QhullError, ValueError):
        return np.array([[0.0, 0.0, 1.0]])  # no area: everything is outside
