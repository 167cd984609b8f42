# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Checks 'beads' and 'distances': beads found from the images alone agree with their survey.

A face or plate of a phantom may be displaced as a whole against its survey. The misclosures of the
beads, from images alone, are fitted by one rigid motion of the whole phantom, and by two motions:
one of a layer of beads and one of all other beads. The layer with the largest decrease of the
weighted sum of squares is displaced if the decrease is significant (F-test of a general linear
hypothesis with known variance: Foerstner and Wrobel, "Photogrammetric Computer Vision", Springer
2016, 3.1), explains most of the excess, and brings the beads of the layer into place. If the sum
of squares is no larger than expected, no layer is displaced: neighbouring beads share errors of
the correction, which the test assumes to be independent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, chdtri, pdtrc

from ..bodies.body import by_pose
from ..estimation.rounds import ResidualTable
from ..findings import Kind, Place, first_few
from ..photogrammetry.noise import SURE
from ..photogrammetry.outliers import CONTRADICTION, FALSE_ALARM
from ..photogrammetry.unknowns import POSE_SIZE
from .bead_intersection import (
    Beads,
    distances,
    intersect,
    least_chi2_without_a_ray,
    rays_of,
)
from .calibration_evidence import Evidence, Subject
from .check import Check, not_made
from .exchanged_beads import exchanged_beads, rate_of

MIN_LAYER = 8  # minimum number of beads in a layer, and outside of it
BORDERS = 40  # number of borders between layers to try along each axis
EXPLAINED = 0.5  # minimum share of the excess sum of squares that a displaced layer explains
IMPROVED = 2.0  # minimum factor by which the median square of its beads decreases


@dataclass(frozen=True)
class DisplacedLayer:
    """Layer of beads that is displaced as a whole."""

    axis: int  #: 0, 1 or 2: coordinate of the survey that bounds the layer
    #: bounds [mm]; None where the phantom ends, so that the layer is a face
    low: float | None
    high: float | None
    target_id: NDArray[np.int64]  #: (k,) beads of the layer
    shift_mm: NDArray[np.float64]  #: (3,) images - survey at its centre, relative to the others
    tilt_rad: float  #: rotation relative to the other beads
    #: RMS displacement of its beads by this motion, and the largest one that is not significant
    size_mm: float
    limit_mm: float

    @property
    def numbers(self) -> dict[str, float]:
        """Size of the motion."""
        shift = float(np.linalg.norm(self.shift_mm))
        return {'shift_mm': shift, 'tilt_deg': float(np.rad2deg(self.tilt_rad))}

    @property
    def cause(self) -> str:
        """Description of the displacement."""
        name = 'xyz'[self.axis]
        if self.low is None:
            layer = f'the face of the phantom with {name} < {self.high:.0f} mm'
        elif self.high is None:
            layer = f'the face of the phantom with {name} > {self.low:.0f} mm'
        else:
            layer = (
                f'the layer of the phantom with {name} from {self.low:.0f} to {self.high:.0f} mm'
            )
        x, y, z = self.shift_mm
        return (
            f'{layer} ({len(self.target_id)} beads) is displaced against its survey by '
            f'{np.linalg.norm(self.shift_mm):.1f} mm ({x:.1f}, {y:.1f}, {z:.1f}) and tilted by '
            f'{np.rad2deg(self.tilt_rad):.2f} deg'
        )


@dataclass(frozen=True)
class _Candidate:
    """Layer to try: beads order[start:stop] along an axis, and the gain of its own motion."""

    axis: int
    order: NDArray[np.int64]
    start: int
    stop: int
    gain: float

    @property
    def own(self) -> NDArray[np.int64]:
        """Row indices of its beads."""
        return self.order[self.start : self.stop]

    def halves(self) -> list[_Candidate]:
        """Return the layer, and its complement if it is a face with half of the beads."""
        count = len(self.order)
        if 2 * (self.stop - self.start) != count or (self.start and self.stop < count):
            return [self]
        complement = (self.stop, count) if self.start == 0 else (0, self.start)
        return [self, replace(self, start=complement[0], stop=complement[1])]


def displaced_layer(beads: Beads) -> DisplacedLayer | None:
    """Return the layer of beads that is displaced as a whole, or None."""
    if len(beads.target_id) < 2 * MIN_LAYER:
        return None
    fit = _Fit(beads)
    candidates = [candidate for axis in range(3) for candidate in fit.candidates(axis)]
    if not candidates:
        return None
    best = max(candidates, key=lambda candidate: candidate.gain)
    critical = float(chdtri(POSE_SIZE, CONTRADICTION / len(candidates)))
    if (
        best.gain < critical
        or fit.excess <= 0
        or best.gain < EXPLAINED * fit.excess
        or fit.improvement(best) < IMPROVED
    ):
        return None
    # Of two equal plates either may have moved against the other: choose the smaller motion.
    layers = [fit.described(candidate, critical) for candidate in best.halves()]
    return min(layers, key=lambda layer: float(np.linalg.norm(layer.shift_mm)))


class _Fit:
    """Rigid motions of layers of beads, fitted to their misclosures."""

    def __init__(self, beads: Beads) -> None:
        self._beads = beads
        self._centre = beads.survey_mm.mean(axis=0)
        self._design = by_pose(beads.survey_mm - self._centre)
        self._information = np.linalg.inv(beads.total_covariance)
        half = self._information @ self._design
        self._normals = np.einsum('nai,naj->nij', self._design, half)
        self._rights = np.einsum('nai,na->ni', half, beads.misclosure)
        self._all = _Equations(self._normals.sum(axis=0), self._rights.sum(axis=0))

    @property
    def excess(self) -> float:
        """Weighted sum of squares after one motion of all beads, minus its expectation."""
        misclosure = self._beads.misclosure - self._design @ self._all.motion
        return float(self._squares(misclosure, slice(None)).sum() - 3 * len(misclosure))

    def candidates(self, axis: int) -> list[_Candidate]:
        """Return the layers along an axis, with the gain of their own motion."""
        coordinate = self._beads.survey_mm[:, axis]
        order = np.argsort(coordinate, kind='stable')
        start, stop = _layers(coordinate[order], self._beads.survey_sd_mm[order]).T
        equations = _Equations(
            _sums(self._normals[order], start, stop), _sums(self._rights[order], start, stop)
        )
        gain = equations.decrease + self._all.without(equations).decrease - self._all.decrease
        return [
            _Candidate(axis, order, *bounds)
            for bounds in zip(start.tolist(), stop.tolist(), gain.tolist())
        ]

    def improvement(self, candidate: _Candidate) -> float:
        """Return the factor by which its own motion decreases the median square of a layer."""
        rows = candidate.own
        motions = self._motions_of_parts(rows)
        after, before = (
            np.median(
                self._squares(self._beads.misclosure[rows] - self._design[rows] @ motion, rows)
            )
            for motion in motions
        )
        return float(before / after)

    def described(self, candidate: _Candidate, critical: float) -> DisplacedLayer:
        """Return a layer with its relative motion; critical: largest gain without significance."""
        rows = candidate.own
        survey = self._beads.survey_mm
        coordinate = survey[candidate.order, candidate.axis]

        def border(at: int) -> float | None:
            if at in (0, len(coordinate)):
                return None
            return float(coordinate[at - 1 : at + 1].mean())

        motion, motion_of_others = self._motions_of_parts(rows)
        relative = motion - motion_of_others
        shifts = self._design[rows] @ relative
        size = float(np.sqrt(np.mean(np.sum(shifts**2, axis=1))))
        middle = by_pose(survey[rows].mean(axis=0) - self._centre)
        return DisplacedLayer(
            candidate.axis,
            border(candidate.start),
            high=border(candidate.stop),
            target_id=self._beads.target_id[rows],
            shift_mm=middle @ relative,
            tilt_rad=float(np.linalg.norm(relative[3:])),
            size_mm=size,
            limit_mm=size * float(np.sqrt(critical / candidate.gain)),
        )

    def _motions_of_parts(
        self, rows: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the motions (6,) of the given beads and of all other beads."""
        equations = _Equations(self._normals[rows].sum(axis=0), self._rights[rows].sum(axis=0))
        return equations.motion, self._all.without(equations).motion

    def _squares(
        self, misclosures: NDArray[np.float64], rows: NDArray[np.int64] | slice
    ) -> NDArray[np.float64]:
        """Return the weighted squares (k,) of remaining misclosures (k, 3) of beads."""
        return np.einsum('na,nab,nb->n', misclosures, self._information[rows], misclosures)


def _layers(coordinate: NDArray[np.float64], sd: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return starts and stops (k, 2) of the layers to try, from sorted coordinates (n,), their sd.

    Borders are at the largest gaps. In a gap of less than SURE standard deviations the errors of
    the survey decide on which side a bead lies, and a layer seems displaced by its selection. Of a
    face and its complement, the smaller one is tried.
    """
    count = len(coordinate)
    gap = np.diff(coordinate)
    gaps = np.argsort(-gap, kind='stable')[:BORDERS] + 1
    regular = np.linspace(0, count, BORDERS // 2).astype(int)[1:-1]
    inner = np.concatenate([gaps, regular])
    is_border = gap > SURE * np.hypot(sd[1:], sd[:-1])
    borders = np.unique(np.concatenate([[0, count], inner[is_border[inner - 1]]]))
    pairs = borders[np.stack(np.triu_indices(len(borders), 1), axis=1)]
    size = pairs[:, 1] - pairs[:, 0]
    return pairs[(size >= MIN_LAYER) & (size <= count // 2)]


def _sums(
    values: NDArray[np.float64], start: NDArray[np.int64], stop: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the sums (k, ...) of values (n, ...) from start (k,) to before stop (k,)."""
    sums = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
    return sums[stop] - sums[start]


@dataclass(frozen=True)
class _Equations:
    """Normal equations of motions: normal (..., 6, 6) and right (..., 6)."""

    normal: NDArray[np.float64]
    right: NDArray[np.float64]

    def without(self, part: _Equations) -> _Equations:
        """Return the equations without the beads of a part."""
        return _Equations(self.normal - part.normal, self.right - part.right)

    @property
    def motion(self) -> NDArray[np.float64]:
        """Motions (..., 6); minimum-norm solution for beads on a line."""
        inverse = np.linalg.pinv(self.normal, hermitian=True, rcond=1e-9)
        return (inverse @ self.right[..., None])[..., 0]

    @property
    def decrease(self) -> np.ndarray:
        """Decrease (...) of the weighted sum of squares by the motion."""
        return np.einsum('...i,...i->...', self.right, self.motion)


MIN_BEADS = 10  # minimum number of beads in a comparison with the survey, or of two halves
# Factor on sds for errors of orientations and calibration that all beads have in common.
SD_FACTOR = 1.1
# Limit as a multiple of the expectation, from simulated rigs with some 500 beads: docs/verdict.md.
# With few beads the limit follows from FALSE_ALARM.
DISTANCES_LIMIT = 1.12


def check_beads(evidence: Evidence, names: Sequence[str]) -> list[Check]:
    """Compare the beads intersected from all fluoroscopes with their survey."""
    result = evidence.result
    rays = rays_of(result, evidence.frames)
    intersected = intersect(rays, result.targets, evidence.phantom)
    has_trend = any(trend.is_significant for trend in evidence.trends.values())
    least_chi2 = partial(least_chi2_without_a_ray, rays, result.targets, evidence.phantom)
    checks = compare_with_survey(intersected, has_trend, least_chi2)
    exchanged = exchanged_beads(rays, result.targets)
    doubtful = rejected_beads(result.residuals)
    is_wrong = any(check.passed is False for check in checks)
    if len(exchanged) and (not is_wrong or set(checks[0].place.target_id) <= set(exchanged.flat)):
        checks[0] = _exchanged(exchanged).after_trend(has_trend)
    elif len(doubtful) and not is_wrong:
        checks[0] = _rejected(doubtful).after_trend(has_trend)
    return checks


def rejected_beads(residuals: ResidualTable) -> NDArray[np.int64]:
    """Return target ids of beads most of whose image points are rejected, more than by chance.

    Too few rays of such a bead may agree to intersect it, while false matches are as frequent
    among its image points as among those of other beads. It is likely that all image points of one
    bead with few of them are rejected by chance; it is unlikely for several beads.
    """
    if not len(residuals.target_id):
        return np.zeros(0, dtype=np.int64)
    target_id, bead = np.unique(residuals.target_id, return_inverse=True)
    seen = np.bincount(bead)
    rejected = np.bincount(bead, residuals.outlier)
    chance = bdtrc(rejected - 1, seen, np.mean(residuals.outlier))
    doubtful = (2 * rejected > seen) & (chance * len(target_id) < FALSE_ALARM)
    seen_often = seen > 1
    expected = np.exp(np.bincount(bead, np.log(_rate_of_exposure(residuals))))[seen_often].sum()
    never_accepted = seen_often & (rejected == seen)
    if pdtrc(np.count_nonzero(never_accepted) - 1, expected) < FALSE_ALARM:
        doubtful |= never_accepted
    return target_id[doubtful]


def _rate_of_exposure(residuals: ResidualTable) -> NDArray[np.float64]:
    """Return the rate (N,) of rejected image points in the exposure of each image point."""
    _, name = np.unique(residuals.fluoroscope, return_inverse=True)
    exposures = np.stack([name, residuals.exposure])
    exposure = np.unique(exposures, axis=1, return_inverse=True)[1].ravel()
    return rate_of(np.bincount(exposure, residuals.outlier), np.bincount(exposure))[exposure]


def _rejected(target_id: NDArray[np.int64]) -> Check:
    """Return the failed check 'beads' for beads whose image points are rejected."""
    return Check(
        Kind.BEADS,
        f'most image points of bead {first_few(target_id)} are rejected, more than false matches '
        'explain: its survey is wrong, or it is exchanged with another bead',
        Place(target_id=tuple(target_id.tolist())),
        'survey it again, and calibrate again',
        numbers={'beads': len(target_id)},
        value=len(target_id),
        limit=0,
        unit='beads',
    )


def _exchanged(pairs: NDArray[np.int64]) -> Check:
    """Return the failed check 'beads' for pairs of exchanged beads, target ids (n, 2)."""
    return Check(
        Kind.BEADS,
        f'bead {first_few(f"{first} is exchanged with {second}" for first, second in pairs)} in '
        'the survey: the image points of each lie where the other is expected',
        Place(target_id=tuple(pairs.ravel().tolist())),
        'exchange them in the phantom file, and calibrate again',
        numbers={'beads': pairs.size},
        value=pairs.size,
        limit=0,
        unit='beads',
    )


def compare_with_survey(
    beads: Beads,
    has_trend: bool = False,
    least_chi2: Callable[[NDArray[np.int64]], NDArray[np.float64]] | None = None,
) -> list[Check]:
    """Return the checks 'beads' and 'distances'.

    has_trend: whether the residuals of a fluoroscope have a trend. least_chi2: function of target
    ids that returns their smallest squared misclosures with one ray excluded; a bead is out of
    place only if these exceed the limit, too.
    """
    count = len(beads.target_id)
    if count < MIN_BEADS:
        reason = f'only {count} beads are seen often enough to be located from the images alone'
        kinds = (Kind.BEADS, Kind.DISTANCES)
        return [not_made(kind, reason, numbers={'beads': count}) for kind in kinds]
    limit = SD_FACTOR**2 * chdtri(3, FALSE_ALARM / count)
    square = beads.chi2
    suspects = np.flatnonzero(square > limit)
    if least_chi2 is not None and len(suspects):
        square[suspects] = np.minimum(square[suspects], least_chi2(beads.target_id[suspects]))
    order = np.argsort(-square)
    wrong_rows = order[square[order] > limit]
    size = np.linalg.norm(beads.misclosure, axis=1)
    worst = order[0]
    named = beads.target_id[[worst]]
    numbers: dict[str, float] = {'beads': count}
    cause = (
        f'bead {beads.target_id[worst]} lies {size[worst]:.2f} mm from its survey, the largest '
        f'deviation of {count}'
    )
    value = size[worst]
    highest = value * np.sqrt(limit / max(square[worst], 1e-9))
    # A face may be displaced significantly although none of its beads is on its own.
    layer = displaced_layer(beads)
    if layer is not None:
        named = layer.target_id
        cause = layer.cause
        numbers |= layer.numbers
        if not len(wrong_rows):
            value = layer.size_mm
            highest = layer.limit_mm
    elif len(wrong_rows) and not has_trend:
        named = beads.target_id[wrong_rows]
        cause = _wrong_beads(named, size[wrong_rows])
    check = Check(
        Kind.BEADS,
        cause,
        Place(target_id=tuple(named.tolist())),
        'survey again, or give a larger sd, and calibrate again',
        numbers=numbers,
        value=value,
        limit=highest,
        unit='mm',
    )
    return [
        check.after_trend(has_trend),
        # A bead that is in place without one of its rays has a false match and is excluded.
        _check_distances(beads.without(beads.target_id[suspects]), has_trend),
    ]


def _wrong_beads(target_id: NDArray[np.int64], size: NDArray[np.float64]) -> str:
    """Return the names of the beads with a wrong survey, and their errors [mm], as text."""
    description = first_few(
        f'{target} is wrong by {mm:.1f} mm' for target, mm in zip(target_id, size)
    )
    return f'the survey of bead {description}'


def _check_distances(beads: Beads, has_trend: bool) -> Check:
    if len(beads.target_id) < MIN_BEADS:
        return not_made(Kind.DISTANCES, 'too few beads agree with their survey', advice='')
    measured = distances(beads)
    by_chance = float(np.sqrt(chdtri(measured.freedom, FALSE_ALARM) / measured.freedom))
    return Check(
        Kind.DISTANCES,
        f'distances between beads differ from the survey by {measured.rmse_mm:.3f} mm, where '
        f'{measured.expected_mm:.3f} mm is expected (scale {1 + measured.scale:.6f}, sd '
        f'{measured.scale_sd:.6f})',
        advice='the survey is less precise than its sd states, or, if other checks fail too, the '
        'calibration is wrong; survey the phantom again, or give a larger sd',
        numbers={'scale': 1 + measured.scale, 'scale_sd': measured.scale_sd},
        value=measured.rmse_mm,
        limit=max(DISTANCES_LIMIT, by_chance) * measured.expected_mm,
        unit='mm',
    ).after_trend(has_trend)


BEADS = Subject(check_beads, of_rig=True)
