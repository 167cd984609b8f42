"""The regression step of the self-calibration for one fluoroscope."""

import numpy as np

from ..photogrammetry.noise import INLIER_Q
from .cross_validation import CrossValidation, NearestTable, candidate_k, exposure_folds
from .gauge import gauge_basis
from .models import CorrectionModel, no_correction
from .smoothers import MIN_K, Neighbourhoods
from .trend import Trend, least_squares_map

KEEP_K = 1e-3  # relative gain in G below which k stays as it is
REACH = 2.0  # factor about the last k within which it is looked for first
STAY_IN = 1.5  # five sigma of each coordinate
MIN_TRAINING = 60  # inliers


class Regressor:
    """Correction model of one fluoroscope through the rounds of a self-calibration.

    kind of the model; uv (N, 2) observed pixels of all image points and exposure (N,) of each:
    they stay where they are, so neighbours are looked up again only when the inliers change.
    interior_held: whether the interior orientation is, which makes the gauge smaller. k:
    neighbours, None: chosen by cross-validation. trend (N, m): functions whose coefficients are
    adjusted; the correction is then kept orthogonal to all of them.
    """

    def __init__(self, kind, uv, exposure, interior_held, k=None, trend=None):
        self.kind = kind
        self.uv = uv
        self.exposure = exposure
        self._interior_held = interior_held
        self.k = 0 if kind == 'none' else k
        self.score = 0.0
        self.changed = False
        self._wanted_k = k
        self._trend = (
            None
            if trend is None
            else np.einsum('nm,ab->nabm', trend, np.eye(2)).reshape(len(uv), 2, -1)
        )
        self.inliers = self._near = None

    def choose(self, values, q, information):
        """Take over the inliers of a round and choose k by its score G.

        values (N, 2) to be fitted [px], q (N,) normalised squared residuals, information (N, 2, 2)
        = C_r^-1. Sets inliers, k, score, and changed, which tells whether inliers or k differ from
        the last round. Raises ValueError for too few inliers.
        """
        before = self.k
        inliers = q <= INLIER_Q
        if self.inliers is not None:
            # Who is in goes out when well outside, who is out comes back when well inside: a point
            # that moves about the border would have the neighbours looked up, and the acceleration
            # begin, anew.
            inliers = np.where(self.inliers, q <= STAY_IN * INLIER_Q, q <= INLIER_Q / 2)
        self.changed = self.inliers is None or not np.array_equal(inliers, self.inliers)
        if self.kind == 'none':
            self.inliers = inliers
            self.score = float(
                np.einsum('na,nab,nb', values[inliers], information[inliers], values[inliers])
            )
            return
        if self.changed:
            self._take_inliers(inliers)
        scores = self._validation.scores(values[inliers], information[inliers])
        best = int(np.argmin(scores))
        while self._wanted_k is None and self._at_border(best):
            self.k = int(self._validation.candidates[best])
            self._take_inliers(inliers)
            scores = self._validation.scores(values[inliers], information[inliers])
            best = int(np.argmin(scores))
        now = np.flatnonzero(self._validation.candidates == self.k)
        if len(now) and scores[now[0]] <= scores[best] * (1 + KEEP_K):
            best = int(now[0])
        self.k = int(self._validation.candidates[best])
        self.score = float(scores[best])
        self.changed = self.changed or before != self.k
        if self.changed:
            self._index = self._near.nearest(np.arange(len(self.uv)), inliers, self.k)
            self._weights = Neighbourhoods(self.uv[self._index], self.uv).weights(
                self.kind, self.k
            )
            self._basis = Trend(self.kind, self.uv[inliers]).basis(self.uv)
            self._trend_fit = least_squares_map(self._basis[inliers])

    def _take_inliers(self, inliers):
        count = int(inliers.sum())
        if count < MIN_TRAINING:
            raise ValueError(
                f'{count} inliers are too few for the correction model, {MIN_TRAINING} are needed'
            )
        wanted = self._wanted_k
        if wanted is not None and not MIN_K[self.kind] <= wanted <= count:
            raise ValueError(f'{self.kind} with k = {wanted} cannot be had from {count} inliers')
        self.inliers = inliers
        candidates = candidate_k(self.kind, count) if wanted is None else [wanted]
        if self._near is None:
            self._near = NearestTable(self.uv, candidates[-1])
        self._all = candidates
        if wanted is None and self.k:  # it moves little from round to round
            candidates = candidates[
                (candidates >= self.k / REACH) & (candidates <= self.k * REACH)
            ]
        self._validation = CrossValidation(
            self.kind,
            self.uv[inliers],
            exposure_folds(self.exposure[inliers]),
            candidates,
            self._near.restricted(inliers),
        )

    def _at_border(self, best):
        """Whether the best of the candidates is the first or last of them, but not of all there
        are.
        """
        candidates = self._validation.candidates
        return (best == 0 and candidates[0] > self._all[0]) or (
            best == len(candidates) - 1 and len(candidates) > 1 and candidates[-1] < self._all[-1]
        )

    def smooth(self, values):
        """Fitted corrections (N, 2) at all image points of values (N, 2) [px]."""
        if self.kind == 'none':
            return np.zeros_like(values)
        trend = self._basis @ (self._trend_fit @ values[self.inliers])
        left = values - trend
        return trend + np.stack(
            [np.einsum('nk,nk->n', self._weights, left[:, axis][self._index]) for axis in (0, 1)],
            axis=1,
        )

    def without_gauge(self, values, interior):
        """Values (N, 2) changed so that their fitted correction is orthogonal to the gauge at the
        inliers.
        """
        if self.kind == 'none':
            return values
        basis = (
            gauge_basis(self.uv, interior, self._interior_held)
            if self._trend is None
            else self._trend
        )
        flat = basis[self.inliers].reshape(-1, basis.shape[2])
        for _ in range(
            1 if self.kind == 'local_linear' else 3
        ):  # means and planes repeat the gauge only nearly
            fitted = self.smooth(values)[self.inliers]
            values = values - basis @ np.linalg.lstsq(flat, fitted.reshape(-1), rcond=None)[0]
        return values

    def model(self, values, series=None):
        """The correction model of values (N, 2), with noise and bias as residuals and
        cross-validation show them.

        series: of a hybrid, that was adjusted and is not in the values.
        """
        if self.kind == 'none':
            return no_correction()
        inside = self.inliers
        error2 = np.mean((values[inside] - self.smooth(values)[inside]) ** 2)
        norm2 = np.mean(np.sum(self._weights[inside] ** 2, axis=1))
        own = self._index == np.arange(len(self._index))[:, None]
        trace = np.mean(np.sum(self._weights * own, axis=1)[inside])
        # E|y - S y|^2 = s^2 (1 - 2 tr(S)/N + tr(S S')/N) for a linear smoother without bias
        # (Hastie, Tibshirani and Friedman, "The Elements of Statistical Learning", 2009, 5.5);
        # held out, the noise of the point itself and of the prediction add up, and what is more is
        # bias.
        noise2 = error2 / max(1 - 2 * trace + norm2, 0.1)
        held_out = self._validation.predictions_for(self.k, values[inside])
        bias2 = np.mean((values[inside] - held_out) ** 2) - noise2 * (1 + norm2)
        uv = self.uv[inside]
        duv = values[inside]
        return CorrectionModel(
            self.kind,
            self.k,
            uv,
            duv if series is None else duv + series.predict(uv),
            float(np.sqrt(noise2)),
            float(np.sqrt(max(bias2, 0.0))),
            series,
        )
