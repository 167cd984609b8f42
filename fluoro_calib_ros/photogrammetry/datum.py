"""Datum of a free network: inner constraints over the object points.

Without surveyed coordinates the images leave seven directions open: the network can be shifted,
turned and scaled. The datum is chosen so that the similarity transformation between object points
and surveyed coordinates, fitted by least squares, is the identity: B^T (P - P0) = 0, B being the
seven directions at the surveyed coordinates. An adjustment holds any seven directions instead,
which changes neither residuals nor estimable quantities; parameters and covariances are
transformed into the datum afterwards (S-transformation: Baarda, "S-transformations and criterion
matrices", Netherlands Geodetic Commission 1973; inner constraints in photogrammetry: Granshaw,
"Bundle adjustment methods in engineering photogrammetry", Photogrammetric Record 10, 1980).
"""

from dataclasses import dataclass, replace

import numpy as np

from .relative_orientation import RelativePose
from .rotations import cross_matrix

DATUMS = ('survey', 'inner')
DEFECT = 7  # shift, turn and scale


@dataclass(frozen=True)
class Gauge:
    """Directions that the images leave open: exposures e (m, 6, 7), points p (n, 3, 7) and global
    unknowns g (G, 7); constraint (n, 3, 7): B of the object points at the surveyed coordinates.
    """

    e: np.ndarray
    p: np.ndarray
    g: np.ndarray
    constraint: np.ndarray


def directions(points, centre):
    """Change (n, 3, 7) of points (n, 3) [mm] by a shift, a turn and a scale about a centre (3,)."""
    off = points - centre
    return np.concatenate(
        [np.broadcast_to(np.eye(3), (len(points), 3, 3)), -cross_matrix(off), off[:, :, None]],
        axis=2,
    )


def gauge_of(network, parameters):
    """The Gauge of a network at some parameters; None where surveyed coordinates give the datum."""
    if network.datum == 'survey':
        return None
    centre = network.survey_mm.mean(axis=0)
    m = network.shape[1]
    e = np.zeros((m, 6, DEFECT))
    e[:, :3] = directions(parameters.position_mm, centre)
    e[:, 3:, 3:6] = -parameters.rotation
    g = np.zeros((len(network.global_free), DEFECT))
    for columns, pose in zip(network.relative_columns, parameters.relative):
        g[columns.start : columns.start + 3, 6] = pose.translation_mm
    return Gauge(
        e, directions(parameters.points_mm, centre), g, directions(network.survey_mm, centre)
    )


def held_directions(open_directions, diagonal):
    """D (q, 7) so that adding D D^T to a normal matrix holds its open directions (q, 7); diagonal
    (q,) of the matrix.

    D D^T is a projector in the unknowns scaled by the diagonal: it is as large as the matrix
    itself.
    """
    scaled = diagonal[:, None] * open_directions
    return np.linalg.solve(np.linalg.cholesky(open_directions.T @ scaled), scaled.T).T


def in_datum(network, parameters):
    """Parameters of a free network transformed into its datum; the same ones where the survey
    gives it.

    The turn is that of least squares (Horn, Hilden and Negahdaripour, JOSA A 5, 1988), the scale
    that at which the survey fits the points.
    """
    if network.datum == 'survey':
        return parameters
    centre = parameters.points_mm.mean(axis=0)
    survey = network.survey_mm.mean(axis=0)
    off = parameters.points_mm - centre
    wanted = network.survey_mm - survey
    u, _, vt = np.linalg.svd(wanted.T @ off)
    turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    scale = np.sum(wanted**2) / np.sum(wanted * (off @ turn.T))

    def there(points):
        return survey + scale * (points - centre) @ turn.T

    return replace(
        parameters,
        rotation=parameters.rotation @ turn.T,
        position_mm=there(parameters.position_mm),
        points_mm=there(parameters.points_mm),
        relative=tuple(
            RelativePose(p.rotation, scale * p.translation_mm) for p in parameters.relative
        ),
    )


class STransformation:
    """Covariances in another datum: S C S^T with S = 1 - E (B^T E)^-1 B^T, block by block.

    gauge: directions E and constraint B; v_e (m, 6, 7), v_p (n, 3, 7) and v_g (G, 7): C B of the
    covariance C that is at hand.
    """

    def __init__(self, gauge, v_e, v_p, v_g):
        inverse = np.linalg.inv(np.einsum('nia,nib->ab', gauge.constraint, gauge.p))
        self.e, self.p, self.g = (
            (h @ inverse, v) for h, v in ((gauge.e, v_e), (gauge.p, v_p), (gauge.g, v_g))
        )
        self._middle = np.einsum('nia,nib->ab', gauge.constraint, v_p)

    def block(self, covariance, one, other):
        """Covariances (..., i, j) in the new datum; one and other: (H, V) of the two sides, from
        e, p or g.
        """
        (h, v) = one
        (k, w) = other
        t = np.swapaxes
        return covariance - h @ t(w, -1, -2) - v @ t(k, -1, -2) + h @ self._middle @ t(k, -1, -2)
