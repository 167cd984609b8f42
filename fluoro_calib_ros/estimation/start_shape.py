# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Shape of a phantom whose coordinates are unknown, from image points with target ids.

The images of parallel projections have rank three, and factorise into projections and shape
(Tomasi and Kanade, "Shape and motion from image streams under orthography", Int. J. Computer
Vision 9, 1992). Perspective images are turned into parallel ones iteratively. With the axes I, J,
K of an image, its scale s at the centre of the shape and the principal distance c, the image
(u, v) of a target P, relative to the principal point, satisfies

    (u, v) (1 + e) = s (I P, J P) + (u0, v0),    e = s K P / c,

where e is zero in the first iteration (Christy and Horaud, "Euclidean shape and motion from
multiple perspective views by affine iterations", IEEE Trans. Pattern Anal. Mach. Intell. 18,
1996). Parallel projections do not discriminate a shape from its mirror image, which has the
opposite e: both are iterated, and the one with smaller residuals is right.

Targets that an image does not show have no weight. Images and targets are solved alternately,
beginning with the images that have most targets in common. The distortion is unknown, so that the
shape is only approximate: good enough to start an adjustment.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from ..exposures.frame import Frame, Frames
from ..findings import Kind, too_few
from ..photogrammetry.network import MIN_RAYS
from ..photogrammetry.resection import MIN_FLATNESS, ROUNDING

MIN_IMAGES = 3  # three parallel projections of four points determine their shape
MIN_COMMON = 12  # targets that the first images have in common, three times as many as needed
MIN_TARGETS = 8  # known targets of a further image, twice as many as needed
# Sweeps over images and targets before the first metric shape, and iterations of the perspective.
# With a quarter of the sweeps, or half of the iterations, residuals of six virtual phantoms were
# the same to 0.001 px.
SWEEPS = 40
ITERATIONS = 20
# Usual principal distance over the width of the image. In virtual rigs, errors of 25 % changed
# residuals from 0.2 to 0.5 px, and from 1.3 to 3.7 px, and the shape by less than a millimetre.
USUAL_DISTANCE = 4.0
TAIL = 3.0  # scales of the residuals beyond which weights decrease, as those of Cauchy
# Largest residual of parallel projections over the distances of image points from their centre. If
# the depth of a phantom is a third of its distance, perspective changes these by a sixth.
MAX_PERSPECTIVE = 0.25
# Residuals of the mirror image over those of the shape, from which the images tell them apart. It
# is 5 to 18 for six virtual phantoms of 60 to 300 mm, and 1 for one without perspective.
MIN_RATIO = 1.5


@dataclass(frozen=True)
class StartShape:
    """Shape of a phantom, about its centre, along its principal axes, at an arbitrary scale."""

    target_id: NDArray[np.int64]  #: (n,)
    xyz: NDArray[np.float64]  #: (n, 3)
    sd: float  #: standard deviation of a coordinate that corresponds to the residuals
    residual_px: float  #: RMS residual of a coordinate of an image point


def start_shape(
    frames: Frames, principal_distances: Mapping[str, float] | None = None
) -> StartShape:
    """Return the shape of the targets of frames.

    Parameters
    ----------
    frames : mapping of str to sequence of Frame
        By fluoroscope, with at least three frames that have targets in common.
    principal_distances : mapping of str to float, optional
        Principal distances [px] by fluoroscope, to 25 %; by default four times the width.

    Raises
    ------
    DataError
        If the images do not determine a shape, or do not tell it from its mirror image.
    """
    images = [frame for view_frames in frames.values() for frame in view_frames]
    target_id, points = _points(images)
    given = principal_distances or {}
    distance = np.array(
        [given.get(f.fluoroscope, USUAL_DISTANCE * f.image_size[0]) for f in images]
    )
    parallel = _factorised(points)
    found, mirrored = sorted(
        (_in_perspective(parallel, points, distance, sign) for sign in (1.0, -1.0)),
        key=lambda one: one.residual_px,
    )
    if not mirrored.residual_px > MIN_RATIO * found.residual_px:
        raise DataError(
            'the images do not tell the shape of the phantom from its mirror image: residuals are '
            f'{found.residual_px:.2f} and {mirrored.residual_px:.2f} px',
            kind=Kind.UNDETERMINED,
            advice='give approximate coordinates',
            numbers={'ratio': mirrored.residual_px / found.residual_px},
        )
    known = np.isfinite(found.xyz).all(axis=1) & (points.seen.sum(axis=0) >= MIN_RAYS)
    xyz = found.xyz[known] - found.xyz[known].mean(axis=0)
    _, extent, axes = np.linalg.svd(xyz, full_matrices=False)
    if extent[2] < MIN_FLATNESS * extent[0]:
        raise DataError(
            'the targets seem to be flat: their shape is not determined',
            kind=Kind.UNDETERMINED,
            advice='turn the phantom more between the exposures, or give approximate coordinates',
        )
    axes[2] *= np.linalg.det(axes)
    sd = found.residual_px / float(np.nanmedian(found.scale))
    return StartShape(target_id[known], xyz @ axes.T, sd, found.residual_px)


@dataclass(frozen=True)
class _Points:
    """Image points of n targets in m images, relative to the middles of the images [px]."""

    uv: NDArray[np.float64]  #: (m, n, 2), 0 if not seen
    seen: NDArray[np.bool_]  #: (m, n)


def _points(images: Sequence[Frame]) -> tuple[NDArray[np.int64], _Points]:
    """Return target ids (n,) and image points. Raises DataError for too few images."""
    if len(images) < MIN_IMAGES:
        raise DataError(
            f'{too_few(len(images), "image")} to find the shape of a phantom, {MIN_IMAGES} are '
            'needed',
            kind=Kind.FEW_EXPOSURES,
        )
    target_id = np.unique(np.concatenate([frame.target_id for frame in images])).astype(np.int64)
    uv = np.zeros((len(images), len(target_id), 2))
    seen = np.zeros(uv.shape[:2], dtype=bool)
    for row, frame in enumerate(images):
        columns = np.searchsorted(target_id, frame.target_id)
        uv[row, columns] = frame.uv - (np.array(frame.image_size) - 1) / 2
        seen[row, columns] = True
    return target_id, _Points(uv, seen)


@dataclass(frozen=True)
class _Parallel:
    """Parallel projections of targets: uv = axes P + shift."""

    axes: NDArray[np.float64]  #: (m, 2, 3), NaN if not known
    shift: NDArray[np.float64]  #: (m, 2)
    xyz: NDArray[np.float64]  #: (n, 3), NaN if not known

    def residual(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return residuals (m, n, 2) of image points, NaN if image or target are not known."""
        return uv - (self.xyz @ np.swapaxes(self.axes, 1, 2) + self.shift[:, None])

    def transformed(self, matrix: NDArray[np.float64]) -> _Parallel:
        """Return the same projections of targets that a matrix (3, 3) transforms."""
        return _Parallel(self.axes @ np.linalg.inv(matrix), self.shift, self.xyz @ matrix.T)

    def centred(self) -> _Parallel:
        """Return the same projections of targets about their centre."""
        centre = np.nanmean(self.xyz, axis=0)
        return _Parallel(self.axes, self.shift + self.axes @ centre, self.xyz - centre)

    def swept(self, uv: NDArray[np.float64], weight: NDArray[np.float64]) -> _Parallel:
        """Return projections of targets intersected from the images, then of resected images.

        weight: (m, n) weights of image points, 0 if not seen.
        """
        is_known = np.isfinite(self.shift[:, 0])
        axes, shift = np.nan_to_num(self.axes), np.nan_to_num(self.shift)
        used = weight * is_known[:, None]
        matrix = np.einsum('mn,maj,mak->njk', used, axes, axes)
        right = np.einsum('mn,maj,mna->nj', used, axes, uv - shift[:, None])
        xyz = _solved(matrix, right[..., None], (used > 0).sum(axis=0) >= 2)[..., 0]
        rows = np.column_stack([np.nan_to_num(xyz), np.ones(len(xyz))])
        used = weight * np.isfinite(xyz[:, 0])
        matrix = np.einsum('mn,nj,nk->mjk', used, rows, rows)
        right = np.einsum('mn,nj,mna->mja', used, rows, uv)
        enough = (used > 0).sum(axis=1) >= MIN_TARGETS
        solved = np.swapaxes(_solved(matrix, right, enough), 1, 2)
        return _Parallel(solved[..., :3], solved[..., 3], xyz)


def _solved(
    matrix: NDArray[np.float64], right: NDArray[np.float64], determined: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return the solutions (k, u, r) of normal equations, NaN where they are not determined."""
    out = np.full(right.shape, np.nan)
    if determined.any():
        size = np.trace(matrix[determined], axis1=1, axis2=2)[:, None, None]
        unit = np.eye(matrix.shape[1])
        out[determined] = np.linalg.solve(
            matrix[determined] + ROUNDING * size * unit, right[determined]
        )
    return out


def _factorised(points: _Points) -> _Parallel:
    """Return parallel projections of affine shape. Raises DataError if few targets are common."""
    images, targets = _common(points.seen)
    if len(images) < MIN_IMAGES or len(targets) < MIN_COMMON:
        raise DataError(
            f'no {MIN_IMAGES} images have {MIN_COMMON} targets in common, which the shape of the '
            'phantom needs',
            kind=Kind.FEW_TARGETS,
            advice='turn the phantom less from one exposure to the next, or give approximate '
            'coordinates',
        )
    first = points.uv[np.ix_(images, targets)]
    centre = first.mean(axis=1)
    table = np.swapaxes(first - centre[:, None], 1, 2).reshape(-1, len(targets))
    left, size, right = np.linalg.svd(table, full_matrices=False)
    count, total = points.seen.shape
    axes = np.full((count, 2, 3), np.nan)
    axes[images] = (left[:, :3] * size[:3]).reshape(-1, 2, 3)
    shift = np.full((count, 2), np.nan)
    shift[images] = centre
    xyz = np.full((total, 3), np.nan)
    xyz[targets] = right[:3].T
    parallel = _Parallel(axes, shift, xyz)
    for _ in range(SWEEPS):
        parallel = parallel.swept(points.uv, points.seen.astype(float))
    residual = parallel.residual(points.uv)
    used = points.seen & np.isfinite(residual).all(axis=2)
    middle = parallel.centred().shift[:, None]
    share = float(np.sqrt(np.mean(residual[used] ** 2) / np.mean((points.uv - middle)[used] ** 2)))
    if share > MAX_PERSPECTIVE:
        raise DataError(
            f'no rigid shape fits the image points: residuals are {share:.0%} of their distances '
            'from the centre',
            kind=Kind.OTHER_PHANTOM,
            advice='check that an id is that of the same bead in all exposures and fluoroscopes',
            numbers={'share': share},
        )
    return parallel


def _common(seen: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return images and targets of a set of images (m, n) that have many targets in common."""
    images = [int(np.argmax(seen.sum(axis=1)))]
    common = seen[images[0]]
    while len(images) < len(seen):
        counts = (seen & common).sum(axis=1)
        counts[images] = -1
        best = int(np.argmax(counts))
        if counts[best] < MIN_COMMON:
            break
        images.append(best)
        common = common & seen[best]
    return np.array(images), np.flatnonzero(common)


def _metric(parallel: _Parallel) -> _Parallel:
    """Return projections whose two axes are orthogonal and of equal length, by least squares.

    With targets A P, axes M A^-1 are orthogonal if M L M' is a multiple of the unit matrix, where
    L = (A' A)^-1; six linear conditions on L for three images.
    """
    axes = parallel.axes[np.isfinite(parallel.shift[:, 0])]
    axes = axes / np.linalg.norm(axes, axis=(1, 2))[:, None, None]
    u, v = axes[:, 0], axes[:, 1]
    conditions = np.concatenate([_products(u, u) - _products(v, v), _products(u, v)])
    unknown = np.linalg.svd(conditions)[2][-1]
    symmetric = np.empty((3, 3))
    symmetric[_UPPER] = unknown
    symmetric[_UPPER[::-1]] = unknown
    value, vector = np.linalg.eigh(symmetric * np.sign(np.trace(symmetric)))
    # Distortion and perspective may leave a negative value.
    value = np.maximum(value, ROUNDING * value[-1])
    matrix = (vector / np.sqrt(value)).T
    return parallel.transformed(matrix * np.sign(np.linalg.det(matrix))).centred()


_UPPER = np.triu_indices(3)


def _products(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return coefficients (m, 6) of the upper half of L in a' L b for vectors (m, 3)."""
    whole = a[:, :, None] * b[:, None]
    whole = whole + np.swapaxes(whole, 1, 2)
    row, column = _UPPER
    return whole[:, row, column] * np.where(row == column, 0.5, 1.0)


@dataclass(frozen=True)
class _Solution:
    """A shape in perspective images."""

    xyz: NDArray[np.float64]  #: (n, 3), NaN if not known
    scale: NDArray[np.float64]  #: (m,) of images, NaN if not known
    residual_px: float


def _in_perspective(
    parallel: _Parallel, points: _Points, distance: NDArray[np.float64], sign: float
) -> _Solution:
    """Return the shape in perspective images, from an affine one or its mirror image (sign -1).

    distance: (m,) principal distances [px].
    """
    parallel = _metric(parallel)
    parallel = _Parallel(sign * parallel.axes, parallel.shift, sign * parallel.xyz)
    weight = points.seen.astype(float)
    for _ in range(ITERATIONS):
        length = np.linalg.norm(parallel.axes, axis=2)
        scale = length.mean(axis=1)
        unit = parallel.axes / length[..., None]
        forward = np.cross(unit[:, 0], unit[:, 1])
        forward /= np.linalg.norm(forward, axis=1)[:, None]
        nearer = (scale / distance)[:, None] * (forward @ parallel.xyz.T)
        uv = points.uv * (1 + np.nan_to_num(nearer))[..., None]
        parallel = _metric(parallel.swept(uv, weight))
        off = np.linalg.norm(parallel.residual(uv), axis=2)
        counted = points.seen & np.isfinite(off)
        usual = max(float(np.median(off[counted])), ROUNDING)
        weight = np.where(counted, 1 / (1 + (off / (TAIL * usual)) ** 2), points.seen)
    residual = float(np.sqrt(np.average(off[counted] ** 2 / 2, weights=weight[counted])))
    return _Solution(parallel.xyz, scale, residual)
