# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Uncertainty of which terms of a trend exist, and with which variance.

The prior variances of the trend terms are those of the largest marginal likelihood (see `priors`),
and the posterior takes them as known. A term that hardly exceeds its noise may then be left out,
or kept with too small a standard deviation: its mean squared error is up to three times its
variance. Here each term is averaged over its prior: with equal odds it does not exist (Mitchell
and Beauchamp, "Bayesian variable selection in linear regression", JASA 83, 1988), or it has a
variance with the uniform shrinkage prior (Daniels, "A prior for the variance in hierarchical
models", Canadian Journal of Statistics 27, 1999).
"""

from __future__ import annotations

import numpy as np

NODES = 64  # of a quadrature
FAR = 8.0  # standard deviations of a Gaussian beyond which nothing is left


def squared_error_of_kept(ratio: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Expected squared errors (t,) of terms, in units of the variances of their estimates.

    Parameters
    ----------
    ratio : (t,) ndarray
        Estimates without a prior, over their standard deviations.
    kept : (t,) ndarray
        Parts of these estimates that are kept, 0 to 1.

    Returns
    -------
    (t,) ndarray
        Posterior variances about the kept values.
    """
    half = np.square(ratio) / 2
    x, weight = np.polynomial.legendre.leggauss(NODES)
    # Shrinkage k = x^2 is uniform on 0..1; the likelihood is sqrt(k) exp(-k half).
    end = np.minimum(1.0, FAR / np.sqrt(np.maximum(2 * half, 1e-300)))[:, None]
    x = (x + 1) / 2 * end
    k = np.square(x)
    density = weight / 2 * end * 2 * k * np.exp(-k * half[:, None])
    evidence = density.sum(axis=1)
    exists = evidence / (evidence + np.exp(-half))
    density /= evidence[:, None]
    of_kept = 1 - k
    variance = np.sum(density * of_kept, axis=1)
    square = np.sum(density * np.square(of_kept - kept[:, None]), axis=1)
    return exists * (variance + 2 * half * square) + (1 - exists) * 2 * half * np.square(kept)


def covariance_with_uncertain_terms(
    to_terms: np.ndarray, variance: np.ndarray, mean: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """Return the covariance (p, p) of coefficients with that of which terms exist.

    Each term in turn, the prior variances of the others taken as known.

    Parameters
    ----------
    to_terms : (t, p) ndarray
        From coefficients to terms.
    variance : (t,) ndarray
        Prior variances of the terms.
    mean, covariance : (p,) and (p, p) ndarray
        Posterior of the coefficients with these variances.

    Returns
    -------
    (p, p) ndarray
    """
    mixed = covariance @ to_terms.T
    of_terms = np.einsum('tp,pt->t', to_terms, mixed)
    kept = np.clip(1 - of_terms / variance, 1e-12, 1.0)
    alone = of_terms / kept  # variances of the estimates without their priors
    ratio = to_terms @ mean / kept / np.sqrt(alone)
    more = np.maximum(squared_error_of_kept(ratio, kept) * alone - of_terms, 0.0)
    along = mixed * (np.sqrt(more) / of_terms)
    return covariance + along @ along.T
