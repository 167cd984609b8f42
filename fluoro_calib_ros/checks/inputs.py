# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Find input that cannot be right before it is calibrated, and report what is wrong with it.

Each exposure is compared with the phantom by a robust direct linear transformation, which requires
neither the interior orientation nor the pose, and follows a part of the distortion. With the right
phantom and ids its median residual is a few pixels, even with 40 % false matches or strong
distortion. If it is larger, common ways to confuse files are tried in turn: ids that are off by
one or reversed. The projection matrix of a mirrored image fits as well as the right one, but puts
all targets behind the source (Hartley and Zisserman, "Multiple View Geometry", 2nd ed., 2004,
21.1: a reflection changes the sign of the depth).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..correction.series import sd_grid_pixels
from ..errors import DataError
from ..estimation.estimator import interior_about
from ..estimation.options import CalibrationRequest
from ..estimation.result import CalibrationResult, FluoroscopeResult
from ..estimation.rounds import MIN_FITTING
from ..estimation.start_orientation import FEW_TARGETS
from ..exposures.collector import MIN_COMMON_TARGETS
from ..exposures.frame import Frame, Frames, validate_frame
from ..exposures.phantom import MISTAKEN_UNITS, Phantom
from ..findings import Finding, Kind, Place, Severity, first_few
from ..photogrammetry.collinearity import project
from ..photogrammetry.diagnosis import MAX_RELATIVE_SD
from ..photogrammetry.noise import CERTAIN
from ..photogrammetry.plane_resection import is_flat, plane_of
from ..photogrammetry.resection import decompose, robust_dlt, squared_residuals
from ..photogrammetry.rig_orientation import KnownOrientation
from .check import rms
from .mixed_units import AT, DISTANCES_MM, FIT, MAX_TESTED, OFF, mixed_units

BETTER = 0.35  # maximum ratio of median residuals with other and given ids to accept the other ids
MAX_COORDINATE_MM = 1e6  # a kilometre
EXTENT_SHARE = 0.9  # share of the targets within the extent of the phantom
MAX_EXTENT = 6.0  # maximum distance of a target from the middle, over that extent
# Plausible standard deviations of surveyed coordinates, and of image points.
PLAUSIBLE = {'sd_mm': (1e-6, 1e3), 'sigma_px': (1e-4, 1e3)}
MIN_REACH = 0.6  # minimum extent of the image points over the image size, to the right and down
MARGIN = 0.03  # share of an image without image points that says nothing about its size
MIN_SHARE = 0.5  # minimum share of the ids that exist on the phantom
# Median residual over the longer side of the image above which a known orientation is wrong.
WRONG_ORIENTATION = 0.1
SAME_PX = 1e-6  # image points of two exposures are copies if they agree this closely
COPIED = 0.9  # minimum share of identical common image points in a copied exposure

Relabel = Callable[[NDArray[np.int64], Phantom], NDArray[np.int64]]

_PHANTOM = Place(name='phantom')
_MIRRORED = Finding(
    Kind.IMAGE_MIRRORED,
    'the image is mirrored: u must run to the right and v down, and neither u and v nor axes of '
    'the phantom may be interchanged',
)
_OTHER_PHANTOM = Finding(
    Kind.OTHER_PHANTOM,
    'the image points do not fit the phantom: this is another phantom, or the target ids are '
    'wrong',
)
_RIGHT_IDS = 'with the correct ids the image points fit the phantom'
# Common confusions of ids, and functions that return the right ids.
CONFUSIONS: tuple[tuple[Finding, Relabel], ...] = (
    (
        Finding(
            Kind.IDS_SHIFTED,
            f'the target ids are too large by 1: {_RIGHT_IDS}',
            numbers={'shift': 1},
        ),
        lambda ids, phantom: ids - 1,
    ),
    (
        Finding(
            Kind.IDS_SHIFTED,
            f'the target ids are too small by 1: {_RIGHT_IDS}',
            numbers={'shift': -1},
        ),
        lambda ids, phantom: ids + 1,
    ),
    (
        Finding(Kind.IDS_REVERSED, f'the target ids run in the opposite order: {_RIGHT_IDS}'),
        lambda ids, phantom: phantom.target_id[0] + phantom.target_id[-1] - ids,
    ),
)


@dataclass(frozen=True)
class Fit:
    """Fit of an exposure to the phantom.

    misfit_px: median residual of the robust direct linear transformation. is_behind: whether the
    targets lie behind the source. distance_mm: distance of the source from the middle of the
    targets. A mirrored plane looks like one seen from behind, and its distance is unknown.
    """

    misfit_px: float
    is_behind: bool
    distance_mm: float | None


def validate_magnitudes(frames: Frames, phantom: Phantom) -> None:
    """Raise DataError for implausible numbers, which would spoil every calculation."""
    is_remote = np.abs(phantom.xyz_mm).max(axis=1) > MAX_COORDINATE_MM
    if is_remote.any():
        target = int(phantom.target_id[is_remote][0])
        raise DataError(
            f'the coordinates of target {target} are larger than {MAX_COORDINATE_MM:g} mm',
            kind=Kind.IMPLAUSIBLE_NUMBER,
            place=replace(_PHANTOM, target_id=(target,)),
        )
    _require_plausible(
        'sd_mm', 'the standard deviation', phantom.sd_mm, phantom.target_id, _PHANTOM
    )
    if np.ptp(phantom.xyz_mm, axis=0).max() <= 0:
        raise DataError(
            'all targets have the same coordinates', kind=Kind.REPEATED_COORDINATES, place=_PHANTOM
        )
    for frame in (frame for exposures in frames.values() for frame in exposures):
        if frame.sigma is not None:
            sigma, ids = np.asarray(frame.sigma), np.asarray(frame.target_id)
            _require_plausible('sigma_px', 'sigma', sigma, ids, frame.place)


def _require_plausible(
    number: str,
    name: str,
    values: NDArray[np.float64],
    target_id: NDArray[np.int64],
    place: Place,
) -> None:
    """Raise DataError if values (n,) of targets (n,) are not plausible; number: see PLAUSIBLE."""
    low, high = PLAUSIBLE[number]
    unit = number.rpartition('_')[2]
    is_wrong = (values < low) | (values > high)
    if is_wrong.any():
        target = int(target_id[is_wrong][0])
        value = float(values[is_wrong][0])
        raise DataError(
            f'{name} of target {target} is {value:g} {unit}, between {low:g} and {high:g} '
            f'{unit} are plausible',
            kind=Kind.IMPLAUSIBLE_NUMBER,
            place=replace(place, target_id=(target,)),
            numbers={number: value},
        )


def validate_names(names: Iterable[str]) -> None:
    """Raise DataError for names of fluoroscopes that differ only in capital letters, and for none.

    Such names denote one fluoroscope, and are the same file on case-insensitive systems.
    """
    names = list(names)
    if not names:
        raise DataError('there are no frames of any fluoroscope')
    seen: dict[str, str] = {}
    for name in names:
        other = seen.setdefault(name.lower(), name)
        if other != name:
            raise DataError(
                f'fluoroscopes {other} and {name} differ only in case',
                kind=Kind.DUPLICATE_NAME,
                place=Place((other, name), name=''),
                advice='use one name for one fluoroscope, or rename one of two',
            )


def exclusion_reason(frame: Frame, phantom: Phantom) -> Finding | None:
    """Return why a misfitting exposure is excluded, or None if the cause is not found."""
    cause = _cause(frame, phantom)
    return None if cause is None or cause.kind is Kind.OTHER_PHANTOM else cause


def find_wrong_phantom(frames: Frames, phantom: Phantom) -> list[Finding]:
    """Return a finding for every group of targets with implausible coordinates."""
    target_ids = [frame.target_id for exposures in frames.values() for frame in exposures]
    seen = np.isin(phantom.target_id, np.concatenate(target_ids or [np.empty(0, int)]))
    if not seen.any():
        return []
    seen_id = phantom.target_id[seen]
    xyz = phantom.xyz_mm[seen]
    if np.linalg.matrix_rank(xyz - xyz.mean(axis=0)) < 2:
        return []  # all on a line: reported by the calibration
    out = []
    places, place, count = np.unique(xyz, axis=0, return_inverse=True, return_counts=True)
    if count.max() > 1:
        most_frequent = int(np.argmax(count))
        ids = seen_id[place.reshape(-1) == most_frequent]
        x, y, z = places[most_frequent]
        out.append(
            Finding(
                Kind.REPEATED_COORDINATES,
                f'targets {first_few(ids)} are all at ({x:g}, {y:g}, {z:g}) mm',
                replace(_PHANTOM, target_id=tuple(ids.tolist())),
                'a repeated row, or a fill value for targets that are not surveyed',
            )
        )
    distance = np.linalg.norm(xyz - np.median(xyz, axis=0), axis=1)
    extent = float(np.quantile(distance, EXTENT_SHARE))
    remote = distance > MAX_EXTENT * extent
    if extent > 0 and remote.any():
        out.append(
            Finding(
                Kind.REMOTE_TARGETS,
                f'target {first_few(seen_id[remote])} is {distance[remote].max():.0f} mm from '
                f'the centre of the others, most of which are within {extent:.0f} mm',
                replace(_PHANTOM, target_id=tuple(seen_id[remote].tolist())),
                'a wrong coordinate, another unit, or a fill value for targets that are not '
                'surveyed',
                numbers={'distance_mm': float(distance[remote].max()), 'extent_mm': extent},
            )
        )
    return out


def fit_to_phantom(frame: Frame, phantom: Phantom, target_id: NDArray[np.int64]) -> Fit | None:
    """Fit an exposure, using target_id (n,) as its ids, to the phantom.

    Returns None if too few targets are on the phantom, or if they lie on a line.
    """
    rows = phantom.index(target_id)
    on_phantom = rows >= 0
    if np.mean(on_phantom) < MIN_SHARE:
        return None
    xyz = phantom.xyz_mm[rows[on_phantom]]
    uv = np.asarray(frame.uv, dtype=float)[on_phantom]
    try:
        with np.errstate(all='ignore'):
            if is_flat(xyz):
                xy = plane_of(xyz).coordinates(xyz)
                squared = squared_residuals(robust_dlt(xy, uv), xy, uv)
                return Fit(float(np.sqrt(np.median(squared))), False, None)
            projection = robust_dlt(xyz, uv)
            residual = np.sqrt(squared_residuals(projection, xyz, uv))
            _, rotation, source = decompose(projection)
    except (DataError, np.linalg.LinAlgError):
        return None
    depth = ((xyz - source) @ rotation.T)[:, 2]
    if not np.isfinite(residual).all() or not np.isfinite(depth).all():
        return None
    distance = float(np.linalg.norm(source - xyz.mean(axis=0)))
    return Fit(float(np.median(residual)), bool(np.median(depth) < 0), distance)


def find_wrong_input(frames: Frames, phantom: Phantom) -> list[Finding]:
    """Return a finding for every fluoroscope whose exposures do not fit the phantom as given.

    frames are exposures by fluoroscope, each of them valid. The exposures with the most targets
    are tested first, and the others only if these are suspicious; a cause is reported if most of
    all exposures have one. A few wrong exposures are left to the calibration, which excludes them.
    """
    out = []
    for name, exposures in frames.items():
        finding = wrong_image_size(exposures)
        if finding is None or finding.severity is Severity.WARNING:
            finding = _wrong_exposures(exposures, phantom)
        if finding is not None:
            out.append(replace(finding, place=Place((name,))))
    return out


def valid_frames(frames: Frames) -> dict[str, list[Frame]]:
    """Return the frames that are valid individually, by fluoroscope."""
    out: dict[str, list[Frame]] = {}
    for name, exposures in frames.items():
        out[name] = []
        for frame in exposures:
            try:
                validate_frame(frame)
            except DataError:
                continue
            out[name].append(frame)
    return out


def require_phantom(frames: Frames, phantom: Phantom) -> None:
    """Raise DataError if exposures of a calibrated fluoroscope cannot be of the phantom.

    Invalid exposures and those with fewer than FEW_TARGETS targets are not tested.
    """
    findings = []
    for name, exposures in valid_frames(frames).items():
        testable = [frame for frame in exposures if len(frame.target_id) >= FEW_TARGETS]
        finding = _wrong_exposures(testable, phantom)
        if finding is not None:
            findings.append(replace(finding, place=Place((name,))))
    if findings:
        mixed = mixed_units(valid_frames(frames), phantom, is_suspicious=True)
        raise DataError(*([mixed] if mixed else findings))


def find_wrong_orientation(
    frames: Frames, phantom: Phantom, known: Mapping[str, KnownOrientation]
) -> list[Finding]:
    """Return a finding for every fluoroscope whose known orientation its exposures contradict."""
    out = []
    for name, orientation in known.items():
        median = _median_residual(frames[name], phantom, orientation)
        limit = WRONG_ORIENTATION * max(frames[name][0].image_size) if frames[name] else np.inf
        fits = [
            other
            for other, candidate in known.items()
            if other != name and _median_residual(frames[name], phantom, candidate) <= limit
        ]
        if median > limit and fits:
            out.append(
                Finding(
                    Kind.FLUOROSCOPES_INTERCHANGED,
                    f'its image points fit the known orientation of fluoroscope {fits[0]}: the '
                    'fluoroscopes are interchanged',
                    Place((name, fits[0]), name=f'fluoroscope {name}'),
                )
            )
        elif median > limit:
            all_behind = 'most targets would lie behind the source'
            all_far = f'the median error of the image points is {median:.0f} px'
            out.append(
                Finding(
                    Kind.WRONG_KNOWN_ORIENTATION,
                    'the known orientation does not fit: '
                    f'{all_far if np.isfinite(median) else all_behind}',
                    Place((name,)),
                    'check the unit and the frame of the lab, that R and t transform from the '
                    'lab to the sensor, and that v runs down',
                    numbers={'residual_px': median},
                )
            )
    return out


def _median_residual(frames: Sequence[Frame], phantom: Phantom, known: KnownOrientation) -> float:
    """Return the median distance [px] of image points from their targets; 0 without any."""
    distances = [
        _residuals(frame, phantom, known)
        for frame in frames
        if (phantom.index(frame.target_id) >= 0).all()
    ]
    return float(np.median(np.concatenate(distances))) if distances else 0.0


def _residuals(frame: Frame, phantom: Phantom, known: KnownOrientation) -> NDArray[np.float64]:
    """Return distances (n,) [px] of image points from targets; infinite behind the source."""
    xyz = phantom.xyz_mm[phantom.index(frame.target_id)]
    predicted = project(known.rotation, known.position_mm, xyz, known.interior)
    distance = np.linalg.norm(frame.uv - predicted, axis=1)
    return np.where(np.isfinite(distance), distance, np.inf)


def _wrong_exposures(exposures: Sequence[Frame], phantom: Phantom) -> Finding | None:
    """Return the cause that most exposures have in common, or None."""
    ordered = sorted(exposures, key=lambda f: -len(f.target_id))
    causes = [_cause(frame, phantom) for frame in ordered[:MAX_TESTED]]
    if 2 * sum(cause is not None for cause in causes) <= len(causes):
        return None
    causes += [_cause(frame, phantom) for frame in ordered[MAX_TESTED:]]
    named = [cause for cause in causes if cause is not None]
    return max(named, key=named.count) if 2 * len(named) > len(causes) else None


def wrong_image_size(exposures: Sequence[Frame]) -> Finding | None:
    """Return a finding if the image points fill only the upper left part of the image, or None.

    It is a warning if they begin at the left and upper border and end equally far from the right
    and the lower one, as those of an image that is said to be larger than it is.
    """
    if not exposures:
        return None
    size = np.array(exposures[0].image_size)
    low = np.min([np.min(frame.uv, axis=0) for frame in exposures], axis=0)
    reach = np.max([np.max(frame.uv, axis=0) for frame in exposures], axis=0)
    margin = 1 - reach / size
    is_wrong = bool((reach < MIN_REACH * size).all())
    is_doubtful = (
        abs(margin[0] - margin[1]) < MARGIN
        and margin.min() > 3 * MARGIN
        and (low / size).max() < MARGIN
    )
    if not is_wrong and not is_doubtful:
        return None
    return Finding(
        Kind.WRONG_IMAGE_SIZE,
        f'the image points reach only to u = {reach[0]:.0f}, v = {reach[1]:.0f} of an image of '
        f'{size[0]} x {size[1]} px',
        advice='the image size is wrong, or the phantom covers one corner only',
        severity=Severity.ERROR if is_wrong else Severity.WARNING,
        numbers={'largest_u': float(reach[0]), 'largest_v': float(reach[1])},
    )


def doubtful_image_sizes(frames: Frames) -> list[Finding]:
    """Return warnings on the image sizes of exposures by fluoroscope."""
    found = {name: wrong_image_size(exposures) for name, exposures in frames.items()}
    return [
        replace(finding, place=Place((name,)))
        for name, finding in found.items()
        if finding is not None and finding.severity is Severity.WARNING
    ]


def wrong_unit(distance_mm: float, phantom: Phantom) -> Finding | None:
    """Return a finding if the distance of the source implies that the unit must be wrong.

    A phantom larger than its distance is a wide-angle view in any unit.
    """
    low, high = DISTANCES_MM
    if low <= distance_mm <= high:
        return None
    extent = float(np.linalg.norm(np.ptp(phantom.xyz_mm, axis=0)))
    numbers = {'distance_mm': distance_mm, 'extent_mm': extent}
    if distance_mm < min(low, extent):  # their ratio is the same in any unit
        return Finding(
            Kind.SOURCE_TOO_NEAR,
            f'the source would be {distance_mm:.3g} mm from a phantom that is {extent:.3g} mm '
            'large, closer than in a fluoroscope',
            advice='the principal distance is wrong, or the images are from a wide-angle camera',
            numbers=numbers,
        )
    units = [unit for mm, unit in MISTAKEN_UNITS.items() if low <= distance_mm * mm <= high]
    guess = f', but perhaps in {" or ".join(units)}' if units else ''
    return Finding(
        Kind.WRONG_UNIT,
        f'the coordinates of the phantom are not in mm{guess}: it would be {extent:.3g} mm '
        f'large and {distance_mm:.3g} mm from the source',
        numbers=numbers,
    )


def _cause(frame: Frame, phantom: Phantom) -> Finding | None:
    """Return what is wrong with an exposure, or None if no error is found."""
    ids = np.asarray(frame.target_id, dtype=np.int64)
    side = max(frame.image_size)
    fit = fit_to_phantom(frame, phantom, ids)
    if fit is None:
        return None
    if fit.misfit_px < FIT * side:
        return _MIRRORED if fit.is_behind else _unit_cause(phantom, fit)
    for confusion, relabel in CONFUSIONS:
        relabelled = fit_to_phantom(frame, phantom, relabel(ids, phantom))
        if (
            relabelled is not None
            and relabelled.misfit_px < BETTER * fit.misfit_px
            and relabelled.misfit_px < AT * side
        ):
            return confusion
    if fit.misfit_px > OFF * side:
        return _OTHER_PHANTOM
    if fit.is_behind:
        return _MIRRORED
    return _unit_cause(phantom, fit)


def _unit_cause(phantom: Phantom, fit: Fit) -> Finding | None:
    """Return the finding on the unit from a rounded distance, the same for all exposures."""
    if fit.distance_mm is None:
        return None
    digits = -int(np.floor(np.log10(max(fit.distance_mm, 1e-300))))
    return wrong_unit(round(fit.distance_mm, digits), phantom)


def copied_exposures(exposures: Sequence[Frame]) -> list[tuple[Frame, Frame]]:
    """Return the exposures of a fluoroscope that repeat an earlier one, each with the earlier one.

    Copies have the same image points to the last digit; real exposures of a standing phantom
    differ by their noise.
    """
    ordered = sorted(exposures, key=lambda f: f.number)
    if not ordered:
        return []
    ids = np.unique(np.concatenate([frame.target_id for frame in ordered]))
    uv = np.full((len(ordered), len(ids), 2), np.nan)
    for row_uv, frame in zip(uv, ordered):
        row_uv[np.searchsorted(ids, frame.target_id)] = frame.uv
    out = []
    distinct: list[int] = []
    for row, frame in enumerate(ordered):
        originals = np.flatnonzero(_are_copied(uv[row], uv[distinct]))
        if len(originals):
            out.append((frame, ordered[distinct[originals[0]]]))
        else:
            distinct.append(row)
    return out


def shared_exposures(one: Sequence[Frame], other: Sequence[Frame]) -> list[tuple[Frame, Frame]]:
    """Return pairs of exposures of two fluoroscopes that have the same image points.

    This does not occur with two fluoroscopes: one recording was given for both.
    """
    renumbered = [replace(f, number=2 * f.number) for f in one]
    renumbered += [replace(f, number=2 * f.number + 1) for f in other]
    shared = []
    for copy, original in copied_exposures(renumbered):
        if copy.number % 2 != original.number % 2:
            pair = sorted((copy, original), key=lambda f: f.number % 2)
            first, second = (replace(f, number=f.number // 2) for f in pair)
            shared.append((first, second))
    return shared


def _are_copied(uv: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which (k,) of others (k, n, 2) have image points uv (n, 2) [px]; NaN if unseen."""
    u, v = np.moveaxis(np.abs(others - uv), 2, 0)
    distance = np.maximum(u, v)  # max() along such a short axis takes ten times as long
    seen_in_both = np.sum(np.isfinite(distance), axis=1)
    equal = np.sum(distance <= SAME_PX, axis=1)
    return (seen_in_both >= MIN_COMMON_TARGETS) & (equal >= COPIED * seen_in_both)


# Absolute tests of a calibration, for results that no fluoroscope can have.
#
# The verdict compares parts of the exposures with each other, so a fault that all of them share
# passes. These tests compare with physical limits, whatever the input claims. All correct
# calibrations are far from these limits (docs/verdict.md).

# Maximum RMSE after correction, or displacement between pairs, over the longer image side.
MAX_MISFIT = 0.0025
MAX_DISTANCE_CHANGE = 0.2  # maximum change of a fixed distance by the scale of the correction


def implausible(request: CalibrationRequest, result: CalibrationResult) -> list[Finding]:
    """Return a finding for every implausible figure in the result of a calibration."""
    out = []
    for name, figures in result.fluoroscopes.items():
        frames = request.frames[name]
        tests = (
            _large_residuals(figures, frames),
            _few_inliers(figures),
            _wrong_distance(figures, request),
            _wrong_interior(figures, result.calibrations[name]),
        )
        out += [replace(finding, place=Place((name,))) for finding in tests if finding is not None]
    return out


def _large_residuals(figures: FluoroscopeResult, frames: Sequence[Frame]) -> Finding | None:
    """Return a finding if residuals are larger than distortion and noise explain."""
    rmse = rms(figures.rmse_after)
    sigmas = [np.median(frame.sigma) for frame in frames if frame.sigma is not None]
    limit = MAX_MISFIT * max(figures.image_size)
    if sigmas:
        limit = max(limit, CERTAIN * float(np.median(sigmas)))
    if rmse <= limit:
        return None
    return Finding(
        Kind.LARGE_RESIDUALS,
        f'the residuals are too large: RMSE {rmse:.1f} px after the correction, at most '
        f'{limit:.1f} px are plausible; possible causes: false matches, another phantom, or a '
        'change of the distortion between the exposures',
        numbers={'rmse_px': rmse, 'limit_px': limit},
    )


def _few_inliers(figures: FluoroscopeResult) -> Finding | None:
    share = figures.inliers / figures.observations
    if share >= MIN_FITTING:
        return None
    return Finding(
        Kind.FEW_INLIERS,
        f'only {100 * share:.0f} % of the image points fit, at least {100 * MIN_FITTING:.0f} % '
        'are needed; the others are false matches',
        numbers={'share': share},
    )


def _wrong_distance(figures: FluoroscopeResult, request: CalibrationRequest) -> Finding | None:
    """Return a finding if the distance of the source implies a wrong unit of the phantom."""
    centre = request.phantom.xyz_mm.mean(axis=0)
    distances = [np.linalg.norm(e.position_mm - centre) for e in figures.exposures]
    return wrong_unit(float(np.median(distances)), request.phantom)


def _wrong_interior(
    figures: FluoroscopeResult, calibration: FluoroscopeCalibration
) -> Finding | None:
    """Return a finding if the interior orientation is undetermined or implausible."""
    xp, yp, c = figures.interior
    sd = figures.interior_sd
    side = max(figures.image_size)
    if not np.any(sd) and (finding := _wrong_given_distance(calibration)):
        return finding
    if max(sd) > MAX_RELATIVE_SD * c:
        return Finding(
            Kind.INTERIOR_UNDETERMINED,
            f'the interior orientation is not determined: principal distance {c:.0f} px with a '
            f'standard deviation of {sd[2]:.0f} px, principal point within {max(sd[:2]):.0f} px',
            numbers={'sd_c_px': float(sd[2]), 'sd_point_px': float(max(sd[:2]))},
        )
    if _off_centre(figures.interior, figures.image_size) <= side:
        return None
    xp, yp, _ = _interior_about_middle(calibration)
    offset = _off_centre(np.array([xp, yp]), figures.image_size)
    if offset <= side:
        return None
    return Finding(
        Kind.PRINCIPAL_POINT_OFF,
        f'the principal point ({xp:.0f}, {yp:.0f}) is {offset:.0f} px from the centre of the '
        'image',
        advice='wrong target ids, a wrong image size, or another phantom',
        numbers={'offset_px': offset},
    )


def _wrong_given_distance(calibration: FluoroscopeCalibration) -> Finding | None:
    """Return a finding if the fixed principal distance is far from that of the correction."""
    given_px = float(calibration.interior[2])
    shown_px = float(_interior_about_middle(calibration)[2])
    if abs(shown_px / given_px - 1) <= MAX_DISTANCE_CHANGE:
        return None
    return Finding(
        Kind.WRONG_PRINCIPAL_DISTANCE,
        f'the principal distance is fixed at {given_px:.0f} px, but the exposures show about '
        f'{shown_px:.0f} px',
        advice='give it in pixels',
        numbers={'given_px': given_px, 'shown_px': shown_px},
    )


def _off_centre(interior: NDArray[np.float64], image_size: tuple[int, int]) -> float:
    """Return the distance [px] of a principal point from the middle of the image."""
    return float(np.linalg.norm(interior[:2] - (np.array(image_size) - 1) / 2))


def _interior_about_middle(calibration: FluoroscopeCalibration) -> NDArray[np.float64]:
    """Return the interior orientation (3,) [px] in the gauge about the middle of the image.

    A strong affine distortion can move the principal point far away, together with its correction.
    """
    pixels = sd_grid_pixels(calibration.image_size)
    pixels = pixels[~calibration.model.outside(pixels)]
    middle = (np.array(calibration.image_size) - 1) / 2
    try:
        return interior_about(
            middle, pixels, calibration.model.predict(pixels), calibration.interior
        )
    except (ValueError, np.linalg.LinAlgError):
        return calibration.interior
