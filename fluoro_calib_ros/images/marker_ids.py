# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Ids of markers from the shapes of their rigid bodies, in the images of one exposure.

Rays of round shadows are intersected. Among these points in space, the members of a body are those
with its distances: a search with backtracking, like the interpretation trees of Grimson and
Lozano-Perez ("Localizing overlapping parts by searching the interpretation tree", IEEE PAMI 9,
1987). The mirror image of a body has the same distances, but no rotation fits it. If a body fits
in several ways, only members on which they agree are kept. A body is refused if too few remain, or
if it would be found as well among as many random points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import product, repeat
from math import comb

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist, squareform
from scipy.special import chdtri, erfc

from ..bodies.body import Body, fitted_pose
from ..correction.fluoroscope_calibration import Calibrations
from ..errors import DataError
from ..photogrammetry.rig_orientation import RigOrientation
from ..photogrammetry.unknowns import POSE_SIZE
from .marker_intensity import (
    MARKER_SCALES,
    FilteredImage,
    check_image,
    first_shadows,
)
from .marker_points import ShadowPoints, all_among, shadow_points
from .marker_rays import AGREE, CalibratedRig
from .markers import MIN_MEMBERS, FirstMarkers

CHANCE = float(erfc(AGREE / 2**0.5))  # probability that a right distance does not agree
MIN_SHARE = 0.6  # least share of the members that are found
BETTER = 4.0  # factor on the sum of squares up to which another fit of as many members is a rival
# Expected number of equally good random fits in an exposure: one in a day at 100 exposures/s.
MAX_CHANCE = 1e-7
MAX_SHADOWS = 120
MAX_STEPS = 200_000  # largest number of steps of the search


@dataclass(frozen=True)
class _Fit:
    """Points (k,) of the members of a body, -1 for none, and the quality of their fit."""

    point: NDArray[np.int64]
    rms_mm: float
    chi2: float

    @property
    def count(self) -> int:
        return int(np.count_nonzero(self.point >= 0))

    def only(self, members: NDArray[np.bool_]) -> _Fit:
        """Return the fit restricted to some members (k,)."""
        return replace(self, point=np.where(members, self.point, -1))


def identify_markers(
    images: Mapping[str, np.ndarray],
    calibrations: Calibrations,
    orientation: RigOrientation,
    bodies: Sequence[Body],
    angles: Mapping[str, float | None] | None = None,
) -> dict[str, FirstMarkers]:
    """Find the markers of rigid bodies in the images of one exposure.

    Parameters
    ----------
    images : mapping of str to ndarray
        Images of two fluoroscopes or more.
    calibrations : mapping of str to FluoroscopeCalibration
    orientation : RigOrientation
        Orientation of these fluoroscopes.
    bodies : sequence of Body
        Bodies of known shapes.
    angles : mapping of str to float or None, optional
        Angles of the C-arms [rad], for corrections that depend on them; None if unknown.

    Returns
    -------
    dict of str to FirstMarkers
        Markers by fluoroscope, for the bodies that are found and that it sees. Members that are
        not seen are at the places predicted by their body.

    Raises
    ------
    DataError
        If none of the bodies is found, or none fits in one way only, and if no two fluoroscopes
        see those that are found.
    """
    names = list(orientation.fluoroscopes)
    bodies = identifiable(bodies)
    if not bodies:
        raise DataError(f'there is no body with {MIN_MEMBERS} markers with known coordinates')
    rig = CalibratedRig(orientation, calibrations, angles or {})
    for name in names:
        check_image(images[name], calibrations[name].image_size)
    search = _ImageSearch(images, rig, bodies)
    # Other round objects in the images may be larger and more distinct. If there are many bodies,
    # perhaps only one is visible. White letters may make bright markers likely.
    count = sum(len(body.target_id) for body in bodies)
    for bright, scale, strongest in product(
        (None, False, True), MARKER_SCALES[:3], (count, MIN_MEMBERS)
    ):
        none_is_found = len(search.missing) == len(bodies)
        if none_is_found or (bright is None and strongest == count):
            search.look(scale, strongest, bright)
        if not search.missing:
            break
    return search.markers()


class _ImageSearch:
    """Search for bodies in the images of one exposure, by shadows of one size after another."""

    def __init__(
        self, images: Mapping[str, np.ndarray], rig: CalibratedRig, bodies: Sequence[Body]
    ) -> None:
        names = rig.orientation.fluoroscopes
        self._images = {name: FilteredImage(images[name]) for name in names}
        self._rig = rig
        self.missing = list(bodies)
        self._found: dict[str, list[FirstMarkers]] = {}
        self._reason: DataError | None = None

    def look(self, scale: float, strongest: int, bright: bool | None = None) -> None:
        """Search for the missing bodies; the strongest shadows of a size determine their look.

        bright: whether markers are bright, None for what is likely in each image.
        """
        try:
            with ThreadPoolExecutor(len(self._images)) as threads:
                results = threads.map(
                    _shadows_of, self._images.values(), repeat((scale, strongest, bright))
                )
                shadows = list(results)
        except DataError as error:
            self._reason = self._reason or error
            return
        markers, missing = find_bodies(shadows, self._rig, self.missing)
        self._reason = self._reason or next(iter(missing.values()), None)
        self.missing = [body for body in self.missing if body.name in missing]
        for name, view_markers in markers.items():
            self._found.setdefault(name, []).append(view_markers)

    def markers(self) -> dict[str, FirstMarkers]:
        """Return the markers by fluoroscope. Raises DataError if no two fluoroscopes see some."""
        if not self._found and self._reason is not None:
            raise self._reason
        if len(self._found) < 2:
            names = self._rig.orientation.fluoroscopes
            blind = next(name for name in names if name not in self._found)
            raise DataError(f'fluoroscope {blind} sees none of the bodies that others see')
        return {
            name: FirstMarkers(
                np.concatenate([part.target_id for part in parts]),
                np.concatenate([part.uv for part in parts]),
                self._images[name],
            )
            for name, parts in self._found.items()
        }


def _shadows_of(image: FilteredImage, kind: tuple[float, int, bool | None]) -> np.ndarray:
    """Return places (k, 2) of shadows; kind: scale, number, whether they are bright.

    Raises DataError if there are none, or too many of a kind that is not likely in the image.
    """
    scale, strongest, bright = kind
    lights = image.of_scale(scale)
    chosen = lights if bright is None else lights[bright : bright + 1]
    shadows = first_shadows(chosen, strongest)
    if bright is not None and len(shadows.uv) > MAX_SHADOWS:
        raise DataError(f'{len(shadows.uv)} round objects, which noise or texture may be')
    return shadows.strongest(MAX_SHADOWS).uv


def identifiable(bodies: Sequence[Body]) -> tuple[Body, ...]:
    """Return the bodies with enough known markers to give ids, restricted to these markers."""
    return tuple(
        body.rows(body.known) for body in bodies if np.count_nonzero(body.known) >= MIN_MEMBERS
    )


def find_bodies(
    shadows: Sequence[np.ndarray], rig: CalibratedRig, bodies: Sequence[Body]
) -> tuple[dict[str, FirstMarkers], dict[str, DataError]]:
    """Find bodies among shadows (k, 2) of all views.

    Return their markers by fluoroscope, without views that see none of the bodies, and the reasons
    why other bodies are missing, by name.
    """
    points = shadow_points(shadows, rig)
    fits: list[tuple[Body, _Fit]] = []
    missing = {}
    free = np.ones(len(points.xyz), dtype=bool)
    for body in sorted(bodies, key=lambda body: -len(body.target_id)):
        try:
            fit = _fit(body, points, free)
        except DataError as error:
            missing[body.name] = error
            continue
        fits.append((body, fit))
        used_shadows = points.shadow[fit.point[fit.point >= 0]]
        # A shadow belongs to one marker, unless two lie behind each other.
        free &= ~all_among(points.shadow, used_shadows)
    first_markers = {}
    for view, name in enumerate(rig.orientation.fluoroscopes):
        view_markers = _first(view, rig, fits, points, shadows[view])
        if view_markers is not None:
            first_markers[name] = view_markers
    return first_markers, missing


def _fit(body: Body, points: ShadowPoints, free: NDArray[np.bool_]) -> _Fit:
    """Find the members of a body among points. Raises DataError."""
    search = _Search(body, points, free)
    search.run()
    min_count = max(MIN_MEMBERS, int(np.ceil(MIN_SHARE * len(body.target_id))))
    best = search.best
    if best is None or best.count < min_count:
        count = 0 if best is None else best.count
        raise DataError(
            f'body {body.name}: only {count} of {len(body.target_id)} markers fit its shape '
            'in this exposure'
        )
    if _by_chance(body, best, points.xyz[free], _around(body, best, points, free)) > MAX_CHANCE:
        raise DataError(
            f'body {body.name}: {best.count} of {len(body.target_id)} markers fit its shape in '
            f'this exposure, but so may others of {np.count_nonzero(free)} points by chance'
        )
    # If a body fits in more than one way, keep the members on which all ways agree.
    rivals = [fit.point for fit in search.fits if fit.chi2 < BETTER * best.chi2]
    best = best.only((np.array(rivals) == best.point).all(axis=0))
    if best.count < min_count:
        raise DataError(
            f'body {body.name}: its shape fits in more than one way in this exposure, its '
            'distances do not distinguish the markers'
        )
    return best


def _around(body: Body, fit: _Fit, points: ShadowPoints, free: NDArray[np.bool_]) -> float:
    """Return the density of points around a fit [1/mm^3], without those of its own shadows."""
    own = fit.point[fit.point >= 0]
    others = free.copy()
    for column, used in zip(points.shadow.T, points.shadow[own].T):
        others &= ~np.isin(column, used[used >= 0])
    extent = float(pdist(body.xyz_mm[fit.point >= 0]).max())
    away = np.linalg.norm(points.xyz[others] - points.xyz[own].mean(axis=0), axis=1)
    return np.count_nonzero(away < extent) / (4 / 3 * np.pi * extent**3)


def _by_chance(body: Body, fit: _Fit, xyz: NDArray[np.float64], around: float) -> float:
    """Return the expected number of equally good fits among as many random points.

    The points are as dense as those of xyz (n, 3), or as those around the fit [1/mm^3], if they
    are denser, like those of letters. The second member is on a sphere about the first, the third
    on a circle, and each further member at a place that these determine, all to within twice the
    RMS of the fit (Grimson and Huttenlocher, "On the verification of hypothesized matches in
    model-based recognition", IEEE PAMI 13, 1991; the number is that of Desolneux, Moisan and
    Morel, "From Gestalt Theory to Image Analysis", 2008).
    """
    reach = 2 * fit.rms_mm
    distance = float(pdist(body.xyz_mm[fit.point >= 0]).mean())
    anywhere = len(xyz) / max(float(np.prod(np.ptp(xyz, axis=0))), 1.0)
    density = max(anywhere, around)  # points per mm^3
    on_sphere = density * 4 * np.pi * distance**2 * 2 * reach
    on_circle = density * np.pi * distance * (2 * reach) ** 2  # radius: half the distance
    at_place = density * 4 / 3 * np.pi * reach**3
    choices = comb(len(body.target_id), fit.count)
    expected = choices * len(xyz) * on_sphere * on_circle * at_place ** (fit.count - 3)
    return float(expected)


class _Search:
    """Search of a body with backtracking: members are points with the right distances."""

    def __init__(self, body: Body, points: ShadowPoints, free: NDArray[np.bool_]) -> None:
        self.body = body
        self.points = points
        xyz = points.xyz
        member_distances = squareform(pdist(body.xyz_mm))
        point_distance = squareform(pdist(xyz))
        variance = points.variance[:, None] + points.variance
        # Whether two points may be two members: (member, member, point, point).
        self.may_be = [
            [
                (point_distance - distance) ** 2 < AGREE**2 * (variance + sd_a**2 + sd_b**2)
                for distance, sd_b in zip(row, body.sd_mm)
            ]
            for row, sd_a in zip(member_distances, body.sd_mm)
        ]
        self.free = free
        self.fits: list[_Fit] = []  # fits with as many members as the best
        self.steps = 0
        self.choices: list[NDArray[np.int64]] = []  # complete choices that are not evaluated yet
        self.judged = 0
        self.point = np.full(len(body.target_id), -1)

    def run(self) -> None:
        """Search from the first member on."""
        self._extend(0, self.free.copy())
        self._judge()

    def _extend(self, member: int, free: NDArray[np.bool_]) -> None:
        """Choose a point for a member, and recursively for those after it."""
        self.steps += 1
        if self.steps > MAX_STEPS:
            raise DataError(f'body {self.body.name}: too many round shadows to search')
        size = len(self.point)
        point = self.point.tolist()
        chosen = [earlier for earlier in range(member) if point[earlier] >= 0]
        min_count = self.fits[0].count if self.fits else MIN_MEMBERS
        if len(chosen) + size - member < min_count:
            return
        if member == size:
            self.choices.append(self.point.copy())
            # Many are evaluated in the time of one, but a fit ends the search for fewer members.
            if len(self.choices) > self.judged:
                self._judge()
            return
        allowed = free.copy()
        for earlier in chosen:
            allowed &= self.may_be[member][earlier][point[earlier]]
        for candidate in allowed.nonzero()[0].tolist():
            self.point[member] = candidate
            free[candidate] = False
            self._extend(member + 1, free)
            free[candidate] = True
        self.point[member] = -1
        self._extend(member + 1, free)

    def _judge(self) -> None:
        """Compare complete choices with the best fits, those with most members first."""
        by_count: dict[int, list[NDArray[np.int64]]] = {}
        for choice in self.choices:
            by_count.setdefault(int(np.count_nonzero(choice >= 0)), []).append(choice)
        self.judged += len(self.choices)
        self.choices.clear()
        for count in sorted(by_count, reverse=True):
            if self.fits and count < self.fits[0].count:
                return
            choices = np.array(by_count[count])
            member = np.nonzero(choices >= 0)[1].reshape(-1, count)
            point = choices[choices >= 0].reshape(-1, count)
            xyz = self.points.xyz[point]
            variance = self.points.variance[point] + self.body.sd_mm[member] ** 2
            body_xyz = self.body.xyz_mm[member]
            rotation, shift = fitted_pose(body_xyz, xyz, 1 / variance)
            fitted = body_xyz @ np.swapaxes(rotation, 1, 2) + shift[:, None]
            squares = np.sum((fitted - xyz) ** 2, axis=2)
            chi2 = np.sum(squares / variance, axis=1)
            good = np.flatnonzero(chi2 <= chdtri(3 * count - POSE_SIZE, CHANCE))
            if len(good) and self.fits and count > self.fits[0].count:
                self.fits.clear()
            self.fits += [
                _Fit(choices[k], float(np.sqrt(np.mean(squares[k]))), float(chi2[k])) for k in good
            ]

    @property
    def best(self) -> _Fit | None:
        """Closest fit among those with most members."""
        return min(self.fits, key=lambda fit: fit.chi2, default=None)


def _first(
    view: int,
    rig: CalibratedRig,
    fits: Sequence[tuple[Body, _Fit]],
    points: ShadowPoints,
    shadows: NDArray[np.float64],
) -> FirstMarkers | None:
    """Return the markers of a view with these shadows, None if it sees none of the bodies."""
    name = rig.orientation.fluoroscopes[view]
    ids = [np.zeros(0, dtype=np.int64)]
    places = [np.zeros((0, 2))]
    for body, fit in fits:
        chosen = fit.point >= 0
        shadow = points.shadow[fit.point[chosen], view]
        seen = shadow >= 0
        if np.count_nonzero(seen) < MIN_SHARE * len(shadow):
            continue
        rotation, shift = fitted_pose(body.xyz_mm[chosen], points.xyz[fit.point[chosen]])
        members = body.xyz_mm @ rotation.T + shift
        place = rig.project(view, members)
        place[np.flatnonzero(chosen)[seen]] = shadows[shadow[seen]]
        width, height = rig.calibrations[name].image_size
        inside = ((place > 0) & (place < np.array([width - 1, height - 1]))).all(axis=1)
        ids.append(np.asarray(body.target_id)[inside])
        places.append(place[inside])
    target_id = np.concatenate(ids)
    return FirstMarkers(target_id, np.concatenate(places)) if len(target_id) else None
