# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Evidence from rigid bodies of a drift that epipolar residuals cannot show.

A shift along an epipolar line moves the intersected point in depth, and all rays still meet. If
one of two markers of a body is in the area that has drifted and the other is not, the points no
longer fit the shape of the body. With the pose of a body from its image points (see bodies.pose),
let the image points of a marker have the derivatives B with respect to its place, weights W,
S = B'WB and the displacement p = S^-1 B'Wr from the place predicted by the body. A shift of one
pixel in an area moves its markers by q = S^-1 B'W, part of which the pose absorbs: with the
derivative D of the place with respect to the pose, N = sum D'SD and g = sum D'Sq over the area,
the shift has

    score = sum q'S p - g'N^-1 sum D'Sp,  information = sum q'Sq - g'N^-1 g

(Foerstner and Wrobel, "Photogrammetric Computer Vision", Springer 2016, 4.6). Each body thus
measures the drift of an area [px], as every epipolar residual does; displacements across the
epipolar lines are left to the residuals. If all markers of a body shift alike, the pose absorbs
everything: a drift of the whole image along the epipolar lines moves and rotates a body without
deforming it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, erfc

from ..bodies.body import Body, check_bodies, fitted_pose, padded
from ..bodies.image_points import BodyCameras, ImagePoints, Linear, linear_at
from ..bodies.pose import marker_sums
from ..bodies.shapes import REGULAR, learned_shape
from ..photogrammetry.rig_orientation import RigOrientation
from ..photogrammetry.unknowns import POSE_SIZE
from ..reconstruction.reconstruct import IntersectedViews
from ..rows import chosen_rows, joined_rows
from .drift_charts import Block, DriftOptions, ImageAreas

COMPONENTS = 2  # components of a shift in an image, u and v
# Fraction of the systematic standard deviation that markers in an area have in common. Measured
# values are 0.2 to 0.4, because their reference is their state at the start, and markers some
# centimetres apart have individual errors.
COMMON_SYSTEMATIC = 0.5
MIN_PAIRS = 2  # minimum marker pairs per exposure, across the area's border, to test it
LEARNED = 200  # exposures for learning a shape; divides the noise by 14
REWEIGHTINGS = 3
MAX_LEARNING = 5000  # exposures that are stored until all markers are known


@dataclass(frozen=True)
class BodyBlock(Block):
    """Statistics of all bodies together in a block.

    The 2F series are the drifts along u and v in the F fluoroscopes. An area is tested if enough
    marker pairs are on both sides of its border.
    """

    #: (B, 2F, A) score and information of each body
    score_of_body: NDArray[np.float64]
    information_of_body: NDArray[np.float64]
    count: int  #: number of marker places


@dataclass(frozen=True)
class _Seen:
    """Exposure with image points of the bodies, and places (B, M, 3) of their markers."""

    points: ImagePoints
    places: NDArray[np.float64]


class BodyWatch:
    """Converts the image points of rigid bodies into statistics, block by block.

    bodies: shapes that are not given are learned at the start of a stream. sizes: (F, 2), width
    and height of the images [px]. Raises DataError for a marker that belongs to two bodies, and
    for two bodies of the same name.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        orientation: RigOrientation,
        sizes: Sequence[Sequence[int]],
        areas: ImageAreas,
        options: DriftOptions,
    ) -> None:
        check_bodies(bodies)
        self._given = tuple(bodies)
        self._orientation = orientation
        self._sizes = sizes
        self._areas = areas
        self._options = options
        # A quarter of the start, for a marker that is hidden part of the time.
        self._least_blocks = max(1, round(options.learn_s / options.block_s / 4))
        self.names = tuple(body.name for body in bodies)
        self.clear()

    def clear(self) -> None:
        """Forget the learned shapes and all observations."""
        self._set_bodies(self._given)
        self._seen: list[_Seen] = []
        self._learning: list[_Seen] = []
        self._blocks = np.zeros(self._known.shape, dtype=int)  # blocks that show each marker

    def _set_bodies(self, bodies: Sequence[Body]) -> None:
        """Set the shapes; markers whose places are not known yet are ignored."""
        self.bodies = tuple(bodies)
        target_id = padded([body.target_id for body in bodies], -1)
        known = [body.known for body in bodies]
        self._known = padded(known, True)  # padding without a marker counts as known
        self._xyz = np.where(self._known[..., None], padded([b.xyz_mm for b in bodies], 0.0), 0.0)
        self._variance = np.where(self._known, padded([b.sd_mm for b in bodies], 0.0), 0.0) ** 2
        self._cameras = BodyCameras(self._orientation, target_id)

    def add(self, exposure: IntersectedViews) -> None:
        """Add an exposure of the fluoroscopes of the orientation."""
        if not len(exposure.target_id):
            return
        points = self._cameras.sorted(exposure)
        places = self._cameras.places(exposure)
        # Depth needs two intersecting rays.
        has_place = (points.seen.sum(axis=2) > 1) & np.isfinite(places).all(axis=2)
        points = replace(points, seen=points.seen & has_place[..., None])
        self._seen.append(_Seen(points, np.where(has_place[..., None], places, np.nan)))

    def block(self) -> BodyBlock | None:
        """Return the statistics of the exposures since the last call, or None without any.

        Markers that are still being learned do not contribute.
        """
        if not self._seen:
            return None
        seen, self._seen = self._seen, []
        if not self._known.all():
            unknown = [exposure.points.seen.any(axis=2) & ~self._known for exposure in seen]
            self._blocks += np.any(unknown, axis=0)
            new = [exposure for exposure, is_unknown in zip(seen, unknown) if is_unknown.any()]
            self._learning = (self._learning + new)[-MAX_LEARNING:]
        return self._statistics(_joined(seen), len(seen))

    def learn(self) -> None:
        """Learn the places of markers that were not given, once they have been seen often enough.

        Call it after the start of the stream. A marker that appears later is learned later.
        """
        learnable = ~self._known & (self._blocks >= self._least_blocks)
        rows = np.flatnonzero(learnable.any(axis=1))
        if not len(rows):
            return
        bodies = list(self.bodies)
        for row in rows.tolist():
            bodies[row] = self._learned(row, learnable[row])
        self._blocks[rows] = 0
        self._set_bodies(bodies)
        if self._known.all():
            self._learning = []

    def _learned(self, row: int, fresh: NDArray[np.bool_]) -> Body:
        """Return a body with learned places of fresh (M,) markers; known places do not change."""
        body = self.bodies[row]
        count = len(body.target_id)
        is_used = (fresh | self._known[row])[:count]
        step = max(1, len(self._learning) // LEARNED)
        seen = [exposure for exposure in self._learning[::step] if exposure.points.seen[row].any()]
        points = _joined([_row(exposure, row) for exposure in seen]).points
        xyz = np.where(
            is_used[:, None], np.stack([exposure.places[row, :count] for exposure in seen]), np.nan
        )
        places = np.nan_to_num(np.stack([exposure.places[row] for exposure in seen]))
        weight = np.where(points.seen, 1 / points.noise, 0.0)
        identity = (np.eye(3)[None], np.zeros((1, 3)))
        information, _ = marker_sums(
            linear_at(self._cameras, places, identity, points.uv, points.seen), weight
        )
        known = np.asarray(np.isfinite(xyz).all(axis=2))
        known_information = np.where(known[..., None, None], information[:, :count], np.eye(3))
        covariance = np.linalg.inv(known_information)
        shape = learned_shape(body, xyz, covariance)
        new = shape.known & ~body.known
        return replace(
            body,
            xyz_mm=np.where(new[:, None], shape.xyz_mm, body.xyz_mm),
            sd_mm=np.where(new, shape.sd_mm, body.sd_mm),
        )

    def _statistics(self, seen: _Seen, exposures: int) -> BodyBlock:
        """Return the statistics of the bodies in exposures, all of which are solved at once."""
        has_marker = seen.points.seen.any(axis=2) & np.tile(self._known, (exposures, 1))
        rows = np.flatnonzero(np.count_nonzero(has_marker, axis=1) > 1)
        shape = (COMPONENTS * len(self._sizes), len(self._areas))
        if not len(rows):
            none = np.zeros(shape)
            of_body = np.zeros((len(self.bodies), *shape))
            return BodyBlock(
                none,
                none,
                none,
                none.astype(bool),
                score_of_body=of_body,
                information_of_body=of_body,
                count=0,
            )
        body = rows % len(self.bodies)
        has_marker = has_marker[rows]
        points = chosen_rows(seen.points, rows)
        points = replace(points, seen=points.seen & has_marker[..., None])
        places = np.where(has_marker[..., None], seen.places[rows], 0.0)
        pose = fitted_pose(self._xyz[body], places, has_marker.astype(float))
        linear = linear_at(self._cameras, self._xyz[body], pose, points.uv, points.seen)
        drift = _Drift.of(linear, points, self._variance[body])
        inside = self._inside(points)
        statistics = _by_area(drift, self._clipped(drift), inside)
        score, information, amplitude = np.zeros((3, len(self.bodies), *shape))
        for total, values in zip((score, information, amplitude), statistics):
            np.add.at(total, body, values)
        total_information = information.sum(axis=0)
        with np.errstate(divide='ignore', invalid='ignore'):
            systematic = amplitude.sum(axis=0) / total_information
        markers_inside = inside.sum(axis=2)
        pairs = (markers_inside * (has_marker.sum(axis=1)[:, None, None] - markers_inside)).sum(
            axis=0
        )
        return BodyBlock(
            score.sum(axis=0),
            total_information,
            COMMON_SYSTEMATIC * systematic,
            np.repeat(pairs > MIN_PAIRS * exposures, COMPONENTS, axis=0),
            score_of_body=score,
            information_of_body=information,
            count=int(has_marker.sum()),
        )

    def _inside(self, points: ImagePoints) -> NDArray[np.float64]:
        """Return whether (n, F, M, A) image points are seen in an area."""
        member = self._areas.member.T
        parts = []
        for view, size in enumerate(self._sizes):
            uv = points.uv[:, :, view]
            cell = self._areas.cell(uv.reshape(-1, 2), size).reshape(uv.shape[:2])
            parts.append(member[cell] * points.seen[:, :, view, None])
        return np.stack(parts, axis=1)

    def _clipped(self, drift: _Drift) -> NDArray[np.float64]:
        """Return displacements (n, M, 3) [mm] from the robust pose, clipped.

        They are clipped at the size that noise, systematic errors and the smallest detectable
        drift explain. The pose is estimated with Huber weights (1964) by reweighting.
        """
        options = self._options
        noise = np.sqrt(chdtri(3, erfc(options.clip / np.sqrt(2))))
        largest = np.sqrt(drift.square.max(axis=(2, 3)))
        limit = (
            noise
            + options.band_start * np.sqrt(3 * drift.systematic)
            + (options.tolerance_px + 2 * options.step_px) * largest
        )
        count = len(limit)
        gradient = drift.pulled @ drift.displacement[..., None]
        contributions = np.concatenate([drift.pulled @ drift.by_pose, gradient], axis=3)
        contributions = contributions.reshape(count, -1, POSE_SIZE * (POSE_SIZE + 1))
        p = drift.displacement
        for _ in range(REWEIGHTINGS):
            length = np.sqrt(np.sum(p * (drift.s_matrix @ p[..., None])[..., 0], axis=2))
            weight = np.minimum(1.0, limit / np.maximum(length, 1e-9))[..., None]
            sums = (weight.transpose(0, 2, 1) @ contributions).reshape(
                count, POSE_SIZE, POSE_SIZE + 1
            )
            step = _inverse(sums[..., :POSE_SIZE]) @ sums[..., POSE_SIZE:]
            p = drift.displacement - (drift.by_pose @ step[:, None])[..., 0]
        p = p * weight
        absorbed = drift.inverse @ (drift.pulled @ p[..., None]).sum(axis=1)
        return p - (drift.by_pose @ absorbed[:, None])[..., 0]


@dataclass(frozen=True)
class _Drift:
    """Effect of shifts in the images on markers (n, M) of bodies.

    s_matrix (n, M, 3, 3); displacement (n, M, 3) from the place predicted by the body [mm];
    weighted (n, M, F, 2, 3), W B of image points; square (n, M, F, 2), q'Sq; systematic (n, M),
    variance of a coordinate due to systematic errors relative to noise; by_pose D; pulled
    (n, M, 6, 3), D'S; inverse (n, 6, 6) of N.
    """

    s_matrix: NDArray[np.float64]
    displacement: NDArray[np.float64]
    weighted: NDArray[np.float64]
    square: NDArray[np.float64]
    systematic: NDArray[np.float64]
    by_pose: NDArray[np.float64]
    pulled: NDArray[np.float64]
    inverse: NDArray[np.float64]

    @classmethod
    def of(cls, linear: Linear, points: ImagePoints, variance: NDArray[np.float64]) -> _Drift:
        """Return the effect for image points at a pose, and shapes of variances (n, M) [mm^2]."""
        weight = np.where(points.seen, 1 / points.noise, 0.0)
        s_matrix, s_vector = marker_sums(linear, weight)
        regular = np.asarray(points.seen.any(axis=2))[..., None, None]
        inverse = np.linalg.inv(np.where(regular, s_matrix, np.eye(3)))
        weighted = linear.by_place * weight[..., None, None]
        square = np.sum((weighted @ inverse[:, :, None]) * weighted, axis=-1)
        systematic = np.sum(points.correction[..., None] * square, axis=(2, 3))
        systematic = systematic + variance * np.trace(s_matrix, axis1=2, axis2=3)
        pulled = np.swapaxes(linear.by_pose, 2, 3) @ s_matrix
        return cls(
            s_matrix,
            displacement=(inverse @ s_vector[..., None])[..., 0],
            weighted=weighted,
            square=square,
            systematic=systematic / 3,
            by_pose=linear.by_pose,
            pulled=pulled,
            inverse=_inverse((pulled @ linear.by_pose).sum(axis=1)),
        )


def _inverse(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return inverses (n, 6, 6) of normal matrices; two markers leave one rotation free."""
    diagonal = REGULAR * normal.max(axis=(1, 2), keepdims=True) * np.eye(POSE_SIZE)
    return np.linalg.inv(normal + diagonal)


def _by_area(
    drift: _Drift, displacement: NDArray[np.float64], inside: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return score, information, systematic error of the score (n, 2F, A) of shifts of areas."""
    n, views, markers, areas = inside.shape
    columns = np.concatenate(
        [
            (drift.weighted @ displacement[:, :, None, :, None])[..., 0],
            drift.square,
            (drift.weighted @ drift.by_pose[:, :, None]).reshape(n, markers, views, -1),
        ],
        axis=3,
    )
    sums = np.swapaxes(inside, 2, 3) @ np.swapaxes(columns, 1, 2)  # (n, F, A, .)
    absorbed = sums[..., 2 * COMPONENTS :].reshape(n, views, areas, COMPONENTS, POSE_SIZE)
    absorbed = np.sum((absorbed @ drift.inverse[:, None, None]) * absorbed, axis=-1)
    information = np.maximum(sums[..., COMPONENTS : 2 * COMPONENTS] - absorbed, 0.0)
    # A systematic error of the images affects the score like noise, but in all exposures.
    marker_count = inside.any(axis=(1, 3)).sum(axis=1)
    share = drift.systematic.sum(axis=1) / marker_count
    amplitude = np.sqrt(share[:, None, None, None] * information)
    score, information, amplitude = (
        np.swapaxes(values, 2, 3).reshape(n, -1, areas)
        for values in (sums[..., :COMPONENTS], information, amplitude)
    )
    return score, information, amplitude


def _joined(seen: Sequence[_Seen]) -> _Seen:
    """Return all exposures as a single one with correspondingly more bodies."""
    points = joined_rows([exposure.points for exposure in seen])
    return _Seen(points, np.concatenate([exposure.places for exposure in seen]))


def _row(seen: _Seen, row: int) -> _Seen:
    """Return one body of an exposure."""
    chosen = slice(row, row + 1)
    return _Seen(chosen_rows(seen.points, chosen), seen.places[chosen])
