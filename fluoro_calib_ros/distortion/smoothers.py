"""Weights of the linear smoothers: a prediction is a weighted sum of the k nearest training
values.

knn: the mean of the k nearest (Chow et al., section 3). local_linear: a plane fitted to the k
nearest with tricube weights (Cleveland, "Robust locally weighted regression", JASA 1979),
evaluated at the query point: unlike the mean it has no bias where all neighbours lie to one side,
as they do at the rim of an image.
"""

import numpy as np

KINDS = ('none', 'knn', 'local_linear', 'parametric', 'hybrid', 'collocation')
MIN_K = {'knn': 1, 'local_linear': 6, 'hybrid': 6}  # of the kinds that have neighbours
SMOOTHERS = tuple(MIN_K)
RIDGE = 1e-6  # of the slopes, relative to the tricube weights: keeps collinear neighbours harmless


class Neighbourhoods:
    """Offsets from n query points to their nearest training points, ascending in distance.

    neighbours (n, K, 2) and queries (n, 2) [px].
    """

    def __init__(self, neighbours, queries):
        self.dx = neighbours[:, :, 0] - queries[:, :1]
        self.dy = neighbours[:, :, 1] - queries[:, 1:]
        square = self.dx * self.dx + self.dy * self.dy
        self.cubed_distance = square * np.sqrt(square)

    def weights(self, kind, k):
        """Weights (n, k) with which the k nearest training values make the prediction of a kind of
        smoother.
        """
        if kind == 'knn':
            return np.full((len(self.dx), k), 1.0 / k)
        # The k-th neighbour sets the bandwidth; among coincident points it stays positive.
        bandwidth3 = np.maximum(self.cubed_distance[:, k - 1 : k], 1e-18)
        kernel = 1 - self.cubed_distance[:, :k] / bandwidth3
        kernel *= kernel * kernel
        alike = (
            np.einsum('nk->n', kernel) <= 1e-9
        )  # all neighbours at one distance: they count alike
        if alike.any():
            kernel[alike] = 1.0
        return plane_weights(self.dx[:, :k], self.dy[:, :k], kernel, bandwidth3[:, 0] ** (2 / 3))


def plane_weights(dx, dy, kernel, bandwidth2):
    """Weights (n, k) that evaluate at the origin the plane fitted to values at (dx, dy) with
    weights kernel.

    dx, dy, kernel: (n, k); bandwidth2 (n,): squared bandwidth, to which the ridge is relative. The
    weights of a query sum to one and reproduce planes exactly but for the ridge.
    """
    wx = kernel * dx
    wy = kernel * dy
    s0, sx, sy = (np.einsum('nk->n', w) for w in (kernel, wx, wy))
    ridge = RIDGE * s0 * bandwidth2
    sxx = np.einsum('nk,nk->n', wx, dx) + ridge
    syy = np.einsum('nk,nk->n', wy, dy) + ridge
    sxy = np.einsum('nk,nk->n', wx, dy)
    # First column of the inverse of the moment matrix [[s0, sx, sy], [sx, sxx, sxy], [sy, sxy,
    # syy]].
    a = sxx * syy - sxy * sxy
    b = sxy * sy - sx * syy
    c = sx * sxy - sxx * sy
    scale = 1 / (s0 * a + sx * b + sy * c)
    wx *= (b * scale)[:, None]
    wy *= (c * scale)[:, None]
    kernel *= (a * scale)[:, None]
    kernel += wx
    kernel += wy
    return kernel
