# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Shapes of rigid bodies from a recording, combined with their CT measurements.

One least-squares adjustment estimates the coordinates of all markers of a body in its frame, and
its pose in every exposure. Places measured by CT are observations with their standard deviations;
a marker without a CT measurement is estimated from the image points alone. Poses are eliminated
exposure by exposure: with S and s of a marker, its derivatives D with respect to the pose and R
with respect to its coordinates (see `pose`),

    H = sum R'SR - (R'SD) N^-1 (D'SR),   h = sum R's - (R'SD) N^-1 D's.

Images cannot determine a common motion of all markers in the frame of the body: it follows from
CT, and is the uncertainty of the frame. The relative coordinates are in the datum of the markers
(S-transformation; Baarda 1973). Tests of single markers follow Baarda 1968, the condition number
and the mean error of rigid-body fitting ISO 16087:2013.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, ndtr

from ..brief import brief_repr
from ..errors import DataError
from ..exposures.phantom import mistaken_unit
from ..findings import Finding, Kind, Place, Severity
from ..photogrammetry.noise import CERTAIN
from ..photogrammetry.rotations import cross_matrix, nearest_rotation
from ..photogrammetry.unknowns import POSE_SIZE
from .body import Body, by_pose, fitted_pose
from .correction_errors import covariance_of_means

# Maximum share of the places of a marker that may be excluded as false matches. Of 1 % false image
# points some 0.3 % are near enough to the epipolar line to become a place. A marker with more of
# them moves relative to the others.
FALSE_SHARE = 0.05
# ISO 16087:2013 and Valstar et al., "Guidelines for standardization of radiostereometry", Acta
# Orthop. 76, 2005: condition number [1/m] above which markers lie too near a line, and mean error
# of rigid-body fitting [mm] above which a body is not stable.
MAX_CONDITION = 120.0
MAX_MEAN_ERROR_MM = 0.35
REJECT_TAIL = 2 * float(ndtr(-CERTAIN))
SCALE_STEPS = 50  # iterations of a factor along one axis and the attitude
MIN_SD_MM = 1e-3  # a CT measurement that is stated as exact
REGULAR = 1e-10  # share of a normal matrix' largest element that is added to its diagonal
_WRONG_BY_CT = (
    Kind.BODY_DIFFERENT,
    Kind.BODY_SCALED,
    Kind.MARKER_MIGRATED,
    Kind.MARKERS_EXCHANGED,
)


@dataclass(frozen=True)
class BodyPlaces:
    """Places of the markers of a body in T exposures, as points in space."""

    xyz_mm: NDArray[np.float64]  #: (T, m, 3) NaN where a marker is unknown in space
    covariance: NDArray[np.float64]  #: (T, m, 3, 3) covariance of the random errors
    #: (T, m, 3, 3) covariance of correction errors, constant while a marker stands still
    fixed: NDArray[np.float64]
    #: (m, m) covariance of their means over all exposures, relative to `fixed`; None if they are
    #: the same in all exposures and independent between markers
    alike: NDArray[np.float64] | None = None

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Whether (T, m) each marker is known in space."""
        return np.asarray(np.isfinite(self.xyz_mm).all(axis=2))

    def without(self, places: NDArray[np.bool_]) -> BodyPlaces:
        """Return a copy that excludes some places (T, m)."""
        return replace(self, xyz_mm=np.where(places[..., None], np.nan, self.xyz_mm))


@dataclass(frozen=True)
class EstimatedShape:
    """Estimated shape of a body."""

    #: coordinates in its frame, their covariance relative to each other, and the covariance of the
    #: frame from CT
    body: Body
    condition: float  #: condition number [1/m]
    mean_error_mm: float  #: mean error of rigid-body fitting, over all exposures
    exposures: int  #: number of exposures that contributed
    findings: tuple[Finding, ...]


@dataclass(frozen=True)
class LearnedShapes:
    """Shapes of bodies learned with a healthy rig."""

    __repr__ = brief_repr

    #: bodies with the covariance of their coordinates, without markers that were not seen
    bodies: tuple[Body, ...]
    #: id of the orientation with which they were learned, then of those healed with them
    orientation_ids: tuple[str, ...]
    calibration_ids: Mapping[str, str]  #: ids by fluoroscope, at the time of learning
    begin_ns: int  #: stamps of the first and of the last exposure
    end_ns: int
    exposures: int  #: seen by the drift watch and used to estimate the shapes
    findings: tuple[Finding, ...] = ()  #: about bodies, including excluded ones

    def with_healed(self, orientation_id: str) -> LearnedShapes:
        """Return a copy that also belongs to an orientation healed with it."""
        return replace(self, orientation_ids=(*self.orientation_ids, orientation_id))

    def check(self, orientation_id: str) -> None:
        """Raise DataError unless the shapes belong to an orientation."""
        if orientation_id not in self.orientation_ids:
            raise DataError(
                f'the shapes were learned with {self.orientation_ids[0]}, not with the '
                f'orientation {orientation_id}; learn them again while the rig is healthy'
            )


def condition_number(xyz_mm: NDArray[np.float64]) -> float:
    """Return the condition number [1/m] of markers (m, 3), from distances to the best-fit line.

    It is one over the root of the sum of squared distances from that line (Soderkvist and Wedin,
    "Determining the movements of the skeleton using well-configured markers", J. Biomech. 26,
    1993); infinite for markers on a line.
    """
    centred = xyz_mm - xyz_mm.mean(axis=0)
    values = np.linalg.svd(centred, compute_uv=False)
    breadth = float(np.sqrt(np.sum(values[1:] ** 2)))
    return 1000.0 / breadth if breadth > 0 else np.inf


def estimate_shape(body: Body, places: BodyPlaces) -> EstimatedShape:
    """Estimate the shape of a body from the places of its markers in space and from CT.

    Parameters
    ----------
    body : Body
        Body with the known coordinates.
    places : BodyPlaces

    Returns
    -------
    EstimatedShape
        The body is unchanged if no exposure shows three of its markers, or if its coordinates are
        mirrored or in another unit.
    """
    start = _start(body, places)
    if start is None:
        return _unchanged(body, [_unseen(body)])
    findings_on_frame = _wrong_frame(body, places)
    if findings_on_frame:
        return _unchanged(body, findings_on_frame)
    body = _with_observed_sd(body, places, start)
    start = _start(body, places) or start
    adjustment = _adjust(body, places, start)
    # A false place also affects the other markers of its exposure, which are then excluded, too.
    while (is_false := _false_places(adjustment)).any():
        places = places.without(is_false)
        start = _start(body, places)
        if start is None:
            return _unchanged(body, [_unseen(body)])
        adjustment = _adjust(body, places, start)
    known = np.isfinite(adjustment.xyz).all(axis=1)
    findings = _contradictions(body, places, start, adjustment)
    if any(finding.kind in _WRONG_BY_CT for finding in findings):
        corrected = _with_observed_sd(_with_true_ct(body, findings), places, start)
        adjustment = _adjust(corrected, places, _start(corrected, places) or start)
    shape = adjustment.xyz
    frame, relative = _datum(shape[known], adjustment.covariance)
    sd = np.full(len(shape), np.inf)
    sd[known] = np.sqrt(np.diagonal(relative).reshape(-1, 3).mean(axis=1))
    covariance = np.diag(np.full(3 * len(shape), np.inf))
    covariance[np.ix_(np.repeat(known, 3), np.repeat(known, 3))] = relative
    condition = condition_number(shape[known])
    findings += _stability(body, condition, adjustment.mean_error_mm)
    return EstimatedShape(
        replace(body, xyz_mm=shape, sd_mm=sd, frame_covariance=frame, covariance_mm2=covariance),
        condition,
        mean_error_mm=adjustment.mean_error_mm,
        exposures=adjustment.exposures,
        findings=tuple(findings),
    )


def _with_observed_sd(
    body: Body, places: BodyPlaces, start: tuple[NDArray[np.float64], NDArray[np.int64]]
) -> Body:
    """Return a body whose CT coordinates of unknown sd have that of their fit to the images.

    The frame of a body is that of its coordinates, even if their accuracy was not stated. With f
    degrees of freedom the variance is that of Student's t, f / (f - 2) times the estimated one.
    """
    is_unknown = body.known & ~np.isfinite(body.sd_mm)
    both = body.known & np.isfinite(start[0]).all(axis=1)
    freedom = 3 * np.count_nonzero(both) - POSE_SIZE
    if not is_unknown.any() or freedom <= 2:
        return body
    shape = _adjust(_without_ct(body), places, start).xyz
    equal = np.ones(np.count_nonzero(both))
    squares = _squares_of_fit(body.xyz_mm[both], shape[both], equal)
    sd = max(np.sqrt(squares / (freedom - 2)), MIN_SD_MM)
    return replace(body, sd_mm=np.where(is_unknown, sd, body.sd_mm))


def _with_true_ct(body: Body, findings: Sequence[Finding]) -> Body:
    """Return a body at the scale of space, with each CT coordinate at its marker or omitted."""
    xyz = body.xyz_mm
    sd = body.sd_mm
    for finding in findings:
        rows = np.flatnonzero(np.isin(body.target_id, finding.place.target_id))
        if finding.kind == Kind.BODY_DIFFERENT:
            sd = np.full(len(sd), np.inf)
        elif finding.kind == Kind.BODY_SCALED:
            axis = int(finding.numbers['axis'])
            xyz = xyz * _stretch(finding.numbers['factor'], None if axis < 0 else axis)
        elif finding.kind == Kind.MARKERS_EXCHANGED:
            order = np.arange(len(xyz))
            order[rows] = rows[::-1]
            xyz, sd = xyz[order], sd[order]
        elif finding.kind == Kind.MARKER_MIGRATED:
            is_wrong = np.isin(body.target_id, finding.place.target_id)
            xyz = np.where(is_wrong[:, None], np.nan, xyz)
            sd = np.where(is_wrong, np.inf, sd)
    return replace(body, xyz_mm=xyz, sd_mm=sd)


def learned_shape(
    body: Body, xyz_mm: NDArray[np.float64], covariance: NDArray[np.float64]
) -> Body:
    """Return a body with a shape learned from places alone, in its present frame.

    xyz_mm (T, m, 3) and covariance (T, m, 3, 3): as in BodyPlaces. Constant errors are omitted, as
    later observations that are compared with the shape have the same ones.
    """
    without_shape = replace(body, xyz_mm=np.full_like(body.xyz_mm, np.nan))
    learned = estimate_shape(
        without_shape, BodyPlaces(xyz_mm, covariance, np.zeros_like(covariance))
    ).body
    learned = replace(learned, covariance_mm2=None)
    known_in_both = learned.known & body.known
    if np.count_nonzero(known_in_both) < 2:
        return learned
    rotation, shift = fitted_pose(learned.xyz_mm[known_in_both], body.xyz_mm[known_in_both])
    return replace(learned, xyz_mm=learned.xyz_mm @ rotation.T + shift)


@dataclass(frozen=True)
class _Adjustment:
    """Coordinates (m, 3), covariance (3k, 3k) of the k known ones, and fit of the markers.

    test (m,): sum of squares of a marker over its expectation. squares (T, m): weighted squares of
    the residuals of places; 0 for places that are not used.
    """

    xyz: NDArray[np.float64]
    covariance: NDArray[np.float64]
    test: NDArray[np.float64]
    squares: NDArray[np.float64]
    mean_error_mm: float
    exposures: int


def _start(body: Body, places: BodyPlaces) -> tuple[NDArray[np.float64], NDArray[np.int64]] | None:
    """Return initial coordinates (m, 3), NaN for unseen markers, and exposures that give poses.

    The shape is that of the images, so that wrong CT coordinates cannot mislead; CT defines its
    frame.
    """
    seen = places.seen
    min_markers = min(3, len(body.target_id))  # a body of two markers needs only two
    reference = int(np.argmax(seen.sum(axis=1))) if len(seen) else 0
    if not len(seen) or np.count_nonzero(seen[reference]) < min_markers:
        return None
    xyz = places.xyz_mm[reference].copy()
    is_placed = seen[reference].copy()
    # The exposure with the most markers in common with those placed so far places the others.
    while len(row := np.flatnonzero((seen & ~is_placed).any(axis=1))):
        common = np.count_nonzero(seen[row] & is_placed, axis=1)
        nearest = row[np.argmax(common)]
        if common.max() < 3:
            break
        both, new = seen[nearest] & is_placed, seen[nearest] & ~is_placed
        place = places.xyz_mm[nearest]
        rotation, shift = fitted_pose(place[both], xyz[both])
        xyz[new] = place[new] @ rotation.T + shift
        is_placed |= new
    has_ct = is_placed & body.known & np.isfinite(body.sd_mm)
    if np.count_nonzero(has_ct) >= 3:
        rotation, shift = fitted_pose(xyz[has_ct], body.xyz_mm[has_ct])
        xyz = xyz @ rotation.T + shift
    else:
        xyz = xyz - xyz[is_placed].mean(axis=0)
    return xyz, np.flatnonzero(np.count_nonzero(seen & is_placed, axis=1) >= min_markers)


@dataclass(frozen=True)
class _Problem:
    """Places (T, k, 3), their information (T, k, 3, 3), and CT (k, 3) with its weights (k,)."""

    place: NDArray[np.float64]
    information: NDArray[np.float64]
    seen: NDArray[np.bool_]
    ct: NDArray[np.float64]
    ct_weight: NDArray[np.float64]


@dataclass(frozen=True)
class _Reduced:
    """Normal equations of the shape after elimination of the poses.

    solved (T, 6, 3k + 1): N^-1 (D'SR, D's); by_pose (T, k, 3, 6); normal (T, 6, 6).
    """

    matrix: np.ndarray
    right: NDArray[np.float64]
    solved: NDArray[np.float64]
    by_pose: NDArray[np.float64]
    normal: NDArray[np.float64]


def _adjust(
    body: Body, places: BodyPlaces, start: tuple[NDArray[np.float64], NDArray[np.int64]]
) -> _Adjustment:
    """Adjust coordinates and poses together, from initial coordinates and exposures."""
    xyz, rows = start
    known = np.flatnonzero(np.isfinite(xyz).all(axis=1))
    problem = _problem(body, places, xyz, (rows, known))
    shape = xyz[known].copy()
    rotation, shift = fitted_pose(shape, problem.place, problem.seen.astype(float))
    for _ in range(4):  # the problem is nearly linear once poses are known
        reduced = _reduced(problem, shape, rotation, shift)
        covariance = np.linalg.inv(reduced.matrix)
        step = covariance @ reduced.right
        pose_step = reduced.solved[:, :, -1] - reduced.solved[:, :, :-1] @ step
        shape = shape + step.reshape(-1, 3)
        shift = shift + pose_step[:, :3]
        rotation = _turned(rotation, pose_step[:, 3:])
    residual = _residual(problem, shape, rotation, shift)
    out = xyz.copy()
    out[known] = shape
    squares = np.zeros(places.seen.shape)
    squares[np.ix_(rows, known)] = np.sum(
        residual * (problem.information @ residual[..., None])[..., 0], axis=2
    )
    test = np.full(len(xyz), np.nan)
    test[known] = _squares_over_expectation(problem, reduced, squares[np.ix_(rows, known)])
    systematic = _stays(places, (rows, known), problem, reduced, rotation)
    count = max(np.count_nonzero(problem.seen), 1)
    return _Adjustment(
        out,
        covariance + covariance @ systematic @ covariance,
        test=test,
        squares=squares,
        mean_error_mm=float(np.sqrt(np.sum(residual**2) / count)),
        exposures=len(rows),
    )


def _problem(
    body: Body,
    places: BodyPlaces,
    xyz: NDArray[np.float64],
    chosen: tuple[NDArray[np.int64], NDArray[np.int64]],
) -> _Problem:
    """Return the observations in the chosen exposures and of the chosen markers."""
    known = chosen[1]
    has_ct = body.known[known] & np.isfinite(body.sd_mm[known])
    if np.count_nonzero(has_ct) < 3:  # too few to define a frame
        has_ct[:] = False
    weight = np.where(has_ct, 1 / np.maximum(body.sd_mm[known], 1e-6) ** 2, 0.0)
    seen = places.seen[np.ix_(*chosen)]
    total = (places.covariance + places.fixed)[np.ix_(*chosen)]
    information = np.linalg.inv(np.where(seen[..., None, None], total, np.eye(3)))
    return _Problem(
        np.where(seen[..., None], places.xyz_mm[np.ix_(*chosen)], 0.0),
        np.where(seen[..., None, None], information, 0.0),
        seen,
        ct=np.where(has_ct[:, None], body.xyz_mm[known], xyz[known]),
        ct_weight=weight,
    )


def _residual(
    problem: _Problem,
    shape: NDArray[np.float64],
    rotation: NDArray[np.float64],
    shift: NDArray[np.float64],
) -> np.ndarray:
    """Return residuals (T, k, 3) of the places; 0 where a marker is not seen."""
    expected = shape @ np.swapaxes(rotation, 1, 2) + shift[:, None]
    return np.where(problem.seen[..., None], problem.place - expected, 0.0)


def _reduced(
    problem: _Problem,
    shape: NDArray[np.float64],
    rotation: NDArray[np.float64],
    shift: NDArray[np.float64],
) -> _Reduced:
    """Eliminate the poses from the normal equations."""
    exposures, count = problem.seen.shape
    residual = _residual(problem, shape, rotation, shift)
    d = by_pose(shape @ np.swapaxes(rotation, 1, 2))
    transposed = np.swapaxes(d, 2, 3)
    to_body = np.swapaxes(rotation, 1, 2)[:, None]
    rotated_information = problem.information @ rotation[:, None]  # S R
    pull = problem.information @ residual[..., None]  # s
    normal = (transposed @ problem.information @ d).sum(axis=1)
    # Markers on a line leave the rotation about it free, which affects nothing else.
    normal += REGULAR * normal.max(axis=(1, 2), keepdims=True) * np.eye(POSE_SIZE)
    cross = (
        (transposed @ rotated_information)
        .transpose(0, 2, 1, 3)
        .reshape(exposures, POSE_SIZE, 3 * count)
    )
    right = (transposed @ pull).sum(axis=1)
    solved = np.linalg.solve(normal, np.concatenate([cross, right], axis=2))
    flat = cross.reshape(-1, 3 * count)
    matrix = -flat.T @ solved[:, :, :-1].reshape(-1, 3 * count)
    blocks = (to_body @ rotated_information).sum(axis=0) + problem.ct_weight[
        :, None, None
    ] * np.eye(3)
    for k in range(count):
        matrix[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += blocks[k]
    if not problem.ct_weight.any():
        # Inner constraints: the centre and the attitude of the markers are those of the initial
        # coordinates (Foerstner and Wrobel 2016, 4.3.2).
        motion = _motion(shape)
        matrix += np.trace(matrix) / (3 * count) * (motion @ np.linalg.pinv(motion))
    by_shape = (to_body @ pull)[..., 0].sum(axis=0)
    by_shape += problem.ct_weight[:, None] * (problem.ct - shape)
    return _Reduced(
        matrix,
        by_shape.ravel() - flat.T @ solved[:, :, -1].ravel(),
        solved=solved,
        by_pose=d,
        normal=normal,
    )


def _squares_over_expectation(
    problem: _Problem, reduced: _Reduced, squares: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return sums (k,) of weighted squares (T, k) over their redundancy; NaN without any."""
    place_covariance = reduced.by_pose @ np.linalg.inv(reduced.normal)[:, None]
    place_covariance = place_covariance @ np.swapaxes(reduced.by_pose, 2, 3)
    share = np.trace(place_covariance @ problem.information, axis1=2, axis2=3)
    freedom = np.where(problem.seen, 3 - share, 0.0).sum(axis=0)
    return np.where(freedom > 1, squares.sum(axis=0) / np.maximum(freedom, 1), np.nan)


def _false_places(adjustment: _Adjustment) -> NDArray[np.bool_]:
    """Return places (T, m) that are false matches: much larger squares than usual of the marker.

    A marker that moves has large squares in many exposures; its places are not excluded.
    """
    squares = np.where(adjustment.squares > 0, adjustment.squares, np.nan)
    typical = np.ones(squares.shape[1])
    is_used = np.isfinite(squares).any(axis=0)
    # The median of three squares is chdtri(3, 0.5).
    typical[is_used] = np.maximum(1.0, np.nanmedian(squares[:, is_used], axis=0) / chdtri(3, 0.5))
    is_false = adjustment.squares > typical * chdtri(3, REJECT_TAIL)
    return np.asarray(
        is_false & (is_false.sum(axis=0) <= FALSE_SHARE * np.isfinite(squares).sum(axis=0))
    )


def _stays(
    places: BodyPlaces,
    chosen: tuple[NDArray[np.int64], NDArray[np.int64]],
    problem: _Problem,
    reduced: _Reduced,
    rotation: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the covariance of the right-hand side of the shape due to errors of corrections.

    These errors average out only as far as the markers move in the image, and those of
    neighbouring markers move the body as a whole.
    """
    known = chosen[1]
    correlation = (
        np.eye(len(known)) if places.alike is None else places.alike[np.ix_(known, known)]
    )
    seen = problem.seen
    exposures, count = seen.shape
    fixed = np.where(seen[..., None, None], places.fixed[np.ix_(*chosen)], 0.0)
    mean = fixed.sum(axis=0) / np.maximum(seen.sum(axis=0), 1)[:, None, None]
    direct = (np.swapaxes(rotation, 1, 2)[:, None] @ problem.information).sum(axis=0)
    weighted = np.swapaxes(reduced.by_pose, 2, 3) @ problem.information  # (T, k, 6, 3), D'S
    weighted = weighted.transpose(0, 2, 1, 3).reshape(exposures * POSE_SIZE, 3 * count)
    influence = -reduced.solved[:, :, :-1].reshape(-1, 3 * count).T @ weighted
    root = np.zeros((3 * count, 3 * count))
    for k in range(count):
        rows = slice(3 * k, 3 * k + 3)
        influence[rows, rows] += direct[k]
        root[rows, rows] = _root_of(mean[k])
    root = influence @ root
    return root @ np.kron(correlation, np.eye(3)) @ root.T


def _root_of(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the symmetric square root of a covariance."""
    variance, axes = np.linalg.eigh(covariance)
    return np.asarray(axes * np.sqrt(np.maximum(variance, 0.0)) @ axes.T)


def _turned(rotation: NDArray[np.float64], w: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rotations (T, 3, 3) multiplied by small ones from the left, orthonormalised."""
    return nearest_rotation((np.eye(3) + cross_matrix(w)) @ rotation)


def _datum(
    xyz: NDArray[np.float64], covariance: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return covariances of the frame (6, 6) about the centre, and of coordinates in its datum."""
    motion = _motion(xyz)
    inverse_motion = np.linalg.pinv(motion)
    relative = np.eye(len(covariance)) - motion @ inverse_motion
    return inverse_motion @ covariance @ inverse_motion.T, relative @ covariance @ relative.T


def _motion(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return derivatives (3k, 6) of coordinates (k, 3) by a common motion about their centre."""
    return by_pose(xyz - xyz.mean(axis=0)).reshape(-1, POSE_SIZE)


# Findings on what is wrong with a body.


def _unchanged(body: Body, findings: Sequence[Finding]) -> EstimatedShape:
    known = body.xyz_mm[body.known]
    condition = condition_number(known) if len(known) >= 2 else np.inf
    return EstimatedShape(body, condition, np.nan, exposures=0, findings=tuple(findings))


def _warning(
    body: Body,
    kind: Kind,
    cause: str,
    numbers: Mapping[str, float],
    markers: Sequence[int] = (),
) -> Finding:
    """Return a warning about a body, or some of its markers."""
    return replace(
        _error(body, kind, cause, numbers),
        place=_place(body, markers),
        severity=Severity.WARNING,
    )


def _error(body: Body, kind: Kind, cause: str, numbers: Mapping[str, float]) -> Finding:
    """Return a finding on coordinates that are wrong as a whole."""
    return Finding(kind, cause, place=_place(body), numbers=dict(numbers))


def _place(body: Body, markers: Sequence[int] = ()) -> Place:
    return Place(target_id=tuple(int(i) for i in markers), name=f'body {body.name}')


def _unseen(body: Body) -> Finding:
    cause = 'no exposure has three of its markers in space: its shape is not estimated'
    return _warning(body, Kind.BODY_UNSEEN, cause, {'markers': float(len(body.target_id))})


def _wrong_frame(body: Body, places: BodyPlaces) -> list[Finding]:
    """Return a finding if coordinates are mirrored or in another unit."""
    seen = places.seen & body.known
    count = seen.sum(axis=1)
    row = int(np.argmax(count))
    if count[row] < 3:
        return []
    ct = body.xyz_mm[seen[row]]
    measured = places.xyz_mm[row][seen[row]]
    spread = [np.sqrt(np.sum((x - x.mean(axis=0)) ** 2)) for x in (ct, measured)]
    factor = float(spread[1] / spread[0])
    unit = mistaken_unit(factor)
    if unit:
        cause = (
            f'its coordinates are in {unit}, not in mm: distances in space are {factor:.4g} '
            'times larger'
        )
        return [_error(body, Kind.WRONG_UNIT, cause, {'factor': factor})]
    if count[row] < 4:
        return []
    errors = []
    for sign in (1.0, -1.0):
        mirrored = ct * np.array([sign, 1.0, 1.0])
        rotation, shift = fitted_pose(mirrored, measured)
        errors.append(float(np.sqrt(np.mean((mirrored @ rotation.T + shift - measured) ** 2))))
    sd = float(np.sqrt(np.mean(np.where(np.isfinite(body.sd_mm), body.sd_mm, 0.0) ** 2)))
    limit = 4 * np.hypot(sd, np.sqrt(np.nanmedian(places.covariance[..., 0, 0])))
    if errors[1] < limit < errors[0]:
        cause = (
            'its coordinates are mirrored: the points in space deviate from them by '
            f'{errors[0]:.2g} mm, and from their mirror image by {errors[1]:.2g} mm'
        )
        numbers = {'rms_mm': errors[0], 'rms_mirrored_mm': errors[1]}
        return [_error(body, Kind.BODY_MIRRORED, cause, numbers)]
    return []


def _contradictions(
    body: Body,
    places: BodyPlaces,
    start: tuple[NDArray[np.float64], NDArray[np.int64]],
    adjustment: _Adjustment,
) -> list[Finding]:
    """Return findings on loose, migrated or exchanged markers, and on bodies that deform."""
    findings = []
    known = body.known & np.isfinite(adjustment.xyz).all(axis=1) & np.isfinite(body.sd_mm)
    if np.count_nonzero(known) >= 3 and _against_ct(body, known, adjustment):
        # Wrong coordinates of CT have bent the shape: judge both by the images alone.
        adjustment = _adjust(_without_ct(body), places, start)
        findings += _against_ct(body, known, adjustment)
    test = adjustment.test
    typical = float(np.nanmedian(test)) if np.isfinite(test).any() else 1.0
    limit = _limit_of_ratio(places)
    moving = np.flatnonzero(test > limit * max(1.0, typical))
    is_stable = adjustment.mean_error_mm <= MAX_MEAN_ERROR_MM  # otherwise reported elsewhere
    if typical > limit and not len(moving) and is_stable:
        ratio = float(np.sqrt(typical))
        cause = (
            f'it is not rigid: the positions of its markers scatter by {ratio:.1f} times their '
            'standard deviations'
        )
        numbers = {'ratio': ratio, 'mean_error_mm': adjustment.mean_error_mm}
        findings.append(_warning(body, Kind.BODY_NOT_RIGID, cause, numbers))
    for row in moving:
        marker = int(body.target_id[row])
        ratio = float(np.sqrt(test[row]))
        cause = (
            f'marker {marker} moves relative to the others: its positions scatter by '
            f'{ratio:.1f} times their standard deviations'
        )
        findings.append(_warning(body, Kind.MARKER_LOOSE, cause, {'ratio': ratio}, [marker]))
    return findings


def _limit_of_ratio(places: BodyPlaces) -> float:
    """Return the largest mean square of residuals of a marker that chance explains.

    Constant errors are the same in many exposures: count at most ten independent ones.
    """
    freedom = 3 * min(10, int(np.count_nonzero(places.seen.any(axis=1))))
    return float(chdtri(freedom, REJECT_TAIL) / freedom)


def _without_ct(body: Body) -> Body:
    """Return a body whose coordinates do not contribute to its shape."""
    return replace(body, sd_mm=np.full(len(body.sd_mm), np.inf))


def _against_ct(body: Body, known: NDArray[np.bool_], adjustment: _Adjustment) -> list[Finding]:
    """Return findings on CT coordinates of known markers (m,) that contradict a shape."""
    rows = np.flatnonzero(known)
    sd = np.maximum(body.sd_mm[rows], MIN_SD_MM)
    estimated = adjustment.xyz[rows]
    return _wrong_as_a_whole(body, rows, estimated, sd) or _migrated(body, rows, estimated, sd)


def _wrong_as_a_whole(
    body: Body,
    rows: NDArray[np.int64],
    estimated: NDArray[np.float64],
    sd: NDArray[np.float64],
) -> list[Finding]:
    """Return what would make all CT coordinates fit: another scale, or two exchanged markers."""
    given = body.xyz_mm[rows]
    if len(rows) < 4 or _misfit(given, estimated, sd) <= 1:
        return []
    for axis, along in ((None, ''), (0, ' along x'), (1, ' along y'), (2, ' along z')):
        factor = _scale(given, estimated, sd, axis)
        if factor is None:
            continue
        cause = (
            f'distances between its markers in space are{along} {factor:.4f} times those of its '
            'coordinates: check the voxel size of the CT, and the scale of the phantom'
        )
        numbers = {'factor': factor, 'axis': -1.0 if axis is None else float(axis)}
        return [_error(body, Kind.BODY_SCALED, cause, numbers)]
    pair = _exchanged(given, estimated, sd)
    if pair is None:
        return []
    markers = [int(body.target_id[rows[k]]) for k in pair]
    distance = float(np.linalg.norm(given[pair[0]] - given[pair[1]]))
    cause = f'markers {markers[0]} and {markers[1]} are exchanged in CT or in the images'
    numbers = {'distance_mm': distance}
    return [Finding(Kind.MARKERS_EXCHANGED, cause, place=_place(body, markers), numbers=numbers)]


def _migrated(
    body: Body,
    rows: NDArray[np.int64],
    estimated: NDArray[np.float64],
    sd: NDArray[np.float64],
) -> list[Finding]:
    """Compare the shape in the images with that of CT, marker by marker."""
    limit = float(chdtri(3, REJECT_TAIL))
    given = body.xyz_mm[rows]
    out: list[int] = []
    while len(rows) - len(out) >= 4:
        kept = [k for k in range(len(rows)) if k not in out]
        tests = [_against_others(given, estimated, sd, k, kept) for k in kept]
        worst = int(np.argmax(tests))
        if tests[worst] <= limit:
            break
        out.append(kept[worst])
    kept = [k for k in range(len(rows)) if k not in out]
    if _misfit(given[kept], estimated[kept], sd[kept]) > 1:
        return [_different(body, given, estimated)]
    rotation, shift = fitted_pose(estimated[kept], given[kept], 1 / sd[kept] ** 2)
    shifts = estimated @ rotation.T + shift - given
    findings = []
    for k in out:
        marker = int(body.target_id[rows[k]])
        distance = float(np.linalg.norm(shifts[k]))
        cause = (
            f'marker {marker} is {distance:.2g} mm from where CT has it, with a standard '
            f'deviation of {sd[k]:.2g} mm: it has migrated, or is another one'
        )
        numbers = {'distance_mm': distance, 'sd_mm': float(sd[k])}
        findings.append(_warning(body, Kind.MARKER_MIGRATED, cause, numbers, [marker]))
    return findings


def _different(body: Body, given: NDArray[np.float64], estimated: NDArray[np.float64]) -> Finding:
    """Return the finding that coordinates do not fit, whichever of them are excluded."""
    squares = _squares_of_fit(given, estimated, np.ones(len(given)))
    rms = float(np.sqrt(squares / len(given)))
    cause = (
        f'its coordinates deviate from the markers in space by {rms:.2g} mm (RMS), more than '
        'their sd, and no single marker explains it; check ids, axes, units and sd, and whether '
        'they are of this body'
    )
    severity = Severity.ERROR if rms > MAX_MEAN_ERROR_MM else Severity.WARNING
    return replace(_error(body, Kind.BODY_DIFFERENT, cause, {'rms_mm': rms}), severity=severity)


def _against_others(
    ct: NDArray[np.float64],
    adjusted: NDArray[np.float64],
    sd: NDArray[np.float64],
    marker: int,
    markers: Sequence[int],
) -> float:
    """Return the weighted squares of deviations from CT that a marker adds to those of the others.

    This is its squared deviation from the fit of the others over its variance (Baarda 1968), and
    remains valid if the others are nearly on a line, about which their fit is hardly determined.
    """
    others = [k for k in markers if k != marker]
    with_marker, without_marker = (
        _squares_of_fit(ct[rows], adjusted[rows], sd[rows]) for rows in (list(markers), others)
    )
    return with_marker - without_marker


def _squares_of_fit(
    ct: NDArray[np.float64], adjusted: NDArray[np.float64], sd: NDArray[np.float64]
) -> float:
    """Return the weighted squares of deviations of coordinates (k, 3) fitted to CT."""
    rotation, shift = fitted_pose(adjusted, ct, 1 / sd**2)
    return float(np.sum(((adjusted @ rotation.T + shift - ct) / sd[:, None]) ** 2))


def _misfit(
    ct: NDArray[np.float64], adjusted: NDArray[np.float64], sd: NDArray[np.float64]
) -> float:
    """Return the weighted squares of a fit of coordinates (k, 3) to CT, over their limit."""
    return _squares_of_fit(ct, adjusted, sd) / float(chdtri(3 * len(ct) - POSE_SIZE, REJECT_TAIL))


def _stretch(factor: float, axis: int | None) -> NDArray[np.float64]:
    """Return the factors (3,) of coordinates along an axis, or along all of them."""
    return np.where([axis in (None, k) for k in range(3)], factor, 1.0)


def _scale(
    ct: NDArray[np.float64],
    adjusted: NDArray[np.float64],
    sd: NDArray[np.float64],
    axis: int | None,
) -> float | None:
    """Return the factor of CT coordinates along an axis, or all, that makes them fit, or None.

    None, too, if they fit without a single marker, which may have migrated. Least squares; Horn,
    "Closed-form solution of absolute orientation", J. Opt. Soc. Am. A 4, 1987, section 2.D. With
    one axis, the attitude depends on the factor: repeated until both agree.
    """
    others = ~np.eye(len(ct), dtype=bool)
    if any(_misfit(ct[row], adjusted[row], sd[row]) <= 1 for row in others):
        return None
    weight = (1 / sd**2)[:, None]
    arm = ct - np.sum(weight * ct, axis=0) / weight.sum()
    part = slice(None) if axis is None else slice(axis, axis + 1)
    factor = 1.0
    for _ in range(SCALE_STEPS):
        scaled = _stretch(factor, axis) * ct
        rotation, shift = fitted_pose(adjusted, scaled, weight[:, 0])
        fitted = adjusted @ rotation.T + shift
        along = (weight * arm)[:, part]
        factor = float(np.sum(along * fitted[:, part]) / np.sum(along * arm[:, part]))
    return factor if _misfit(_stretch(factor, axis) * ct, adjusted, sd) <= 1 else None


def _exchanged(
    ct: NDArray[np.float64], adjusted: NDArray[np.float64], sd: NDArray[np.float64]
) -> tuple[int, int] | None:
    """Return two markers that agree with CT when exchanged, or None."""
    pairs = list(combinations(range(len(ct)), 2))
    misfits = []
    for first, second in pairs:
        order = np.arange(len(ct))
        order[[first, second]] = second, first
        misfits.append(_misfit(ct[order], adjusted, sd))
    best = int(np.argmin(misfits))
    return pairs[best] if misfits[best] <= 1 else None


def _stability(body: Body, condition: float, mean_error_mm: float) -> list[Finding]:
    """Return findings on markers on a line, and on a body that is not rigid."""
    findings = []
    if condition > MAX_CONDITION:
        line = not np.isfinite(condition) or condition > 100 * MAX_CONDITION
        cause = (
            f'its markers lie {"on" if line else "nearly on"} a line (condition number '
            f'{condition:.0f} per m, at most {MAX_CONDITION:.0f} by ISO 16087): the rotation '
            'about this line is poorly determined'
        )
        findings.append(_warning(body, Kind.BODY_ON_A_LINE, cause, {'condition_per_m': condition}))
    if mean_error_mm > MAX_MEAN_ERROR_MM:
        cause = (
            f'it is not rigid: its markers deviate from its shape by {mean_error_mm:.2g} mm '
            f'(RMS; at most {MAX_MEAN_ERROR_MM} mm by ISO 16087)'
        )
        numbers = {'mean_error_mm': mean_error_mm}
        findings.append(_warning(body, Kind.BODY_NOT_RIGID, cause, numbers))
    return findings


def places_of(
    body: Body,
    target_ids: Sequence[NDArray[np.int64]],
    points: Sequence[Mapping[str, NDArray[np.float64]]],
) -> BodyPlaces:
    """Collect the places of the markers of a body from points in space.

    target_ids: (n,) of each exposure. points: for each exposure 'xyz_mm' (n, 3), 'noise' and
    'fixed' (n, 3, 3), with NaN for points that are not to be used, and 'uv' (n, F, 2), their image
    points in units of the longer side of the images.
    """
    views = points[0]['uv'].shape[1] if len(points) else 0
    shape = (len(target_ids), len(body.target_id))
    parts = {'xyz_mm': (3,), 'noise': (3, 3), 'fixed': (3, 3), 'uv': (views, 2)}
    out = {name: np.full((*shape, *part), np.nan) for name, part in parts.items()}
    for row, (ids, values) in enumerate(zip(target_ids, points)):
        _, columns, rows = np.intersect1d(body.target_id, ids, return_indices=True)
        for name, array in out.items():
            array[row, columns] = values[name][rows]
    alike = covariance_of_means(out['uv']).mean(axis=0)
    return BodyPlaces(out['xyz_mm'], out['noise'], out['fixed'], alike=alike)
