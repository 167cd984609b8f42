# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Frames of image points, rules for valid frames, and exclusion of stray image points.

All inputs apply the same rules: the CSV and bag readers, the nodes and the calculations. Each of
the functions `..._error` checks one rule. It returns '' if the rule is met, otherwise a sentence
about the error, to which the caller prepends the place: a row of a file, a message of a bag, a
frame of a stream.

Image points off the image, or of an unknown target, cannot be used. A few of them are excluded and
reported. Many are a fault of the whole input, such as a wrong image size or another phantom, and
are left to `validate_frame`, which refuses the frame. Many targets at the same image point are a
fill value for targets that are not seen, such as (0, 0), and always excluded.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Sized
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..brief import brief_repr
from ..errors import DataError
from ..findings import Finding, Kind, Place, Severity, first_few
from .names import MAX_ID
from .phantom import Phantom, first_repeated, is_positive

DECIMALS = 4  # decimals of a pixel, and of its standard deviation, in files
MAX_ANGLE = 4 * np.pi  # two turns either way: a larger value is not an angle in radians


@dataclass(frozen=True)
class Frame:
    """Image points of identified targets in one exposure of one fluoroscope.

    Attributes
    ----------
    fluoroscope : str
    number : int
        Frame number; frames of one exposure have the same number.
    target_id : (n,) ndarray of int
    uv : (n, 2) ndarray
        Observed column and row [px].
    image_size : (int, int)
        Width and height [px].
    sigma : (n,) ndarray or None
        Standard deviation of a coordinate [px], None if unknown.
    stamp_ns : int
        Time of the exposure [ns].
    frame_id : str
        Name of the optical frame.
    angle : float or None
        Angle of the C-arm [rad], None if unknown. It is rounded to a microdegree, so that files in
        degrees give the same numbers.
    """

    __repr__ = brief_repr

    fluoroscope: str
    number: int
    target_id: NDArray[np.int64]
    uv: NDArray[np.float64]
    image_size: tuple[int, int]
    sigma: NDArray[np.float64] | None = None
    stamp_ns: int = 0
    frame_id: str = field(default='', compare=False)
    angle: float | None = None

    @property
    def place(self) -> Place:
        """Fluoroscope and exposure, as the place of a finding."""
        return Place((self.fluoroscope,), (int(self.number),))

    def __post_init__(self) -> None:
        if self.angle is not None:
            object.__setattr__(self, 'angle', float(np.radians(angle_in_degrees(self.angle))))

    def rows(self, chosen: NDArray[np.bool_]) -> Frame:
        """Return the frame restricted to some of its targets (n,)."""
        target_id, uv = np.asarray(self.target_id)[chosen], np.asarray(self.uv)[chosen]
        sigma = None if self.sigma is None else np.asarray(self.sigma)[chosen]
        return replace(self, target_id=target_id, uv=uv, sigma=sigma)

    def sorted(self) -> Frame:
        """Return the frame with its targets in ascending order.

        Results must not depend on the order of the input.
        """
        order = np.argsort(self.target_id, kind='stable')
        width, height = self.image_size
        return Frame(
            self.fluoroscope,
            int(self.number),
            target_id=np.asarray(self.target_id, dtype=np.int64)[order],
            uv=np.asarray(self.uv, dtype=float)[order],
            image_size=(int(width), int(height)),
            sigma=None if self.sigma is None else np.asarray(self.sigma, dtype=float)[order],
            stamp_ns=int(self.stamp_ns),
            frame_id=self.frame_id,
            angle=self.angle,
        )


def frames_of_targets(frames: Frames, target_id: NDArray[np.int64]) -> dict[str, list[Frame]]:
    """Return the frames restricted to these targets; frames that show none are excluded."""
    return {
        name: [
            frame.rows(seen)
            for frame in view_frames
            if (seen := np.isin(frame.target_id, target_id)).any()
        ]
        for name, view_frames in frames.items()
    }


def validate_frame(
    frame: Frame, phantom: Phantom | None = None, image_size: tuple[int, int] | None = None
) -> None:
    """Validate a frame before it is used in a calculation.

    If a phantom is given, all targets must belong to it; if image_size [px], that of the
    calibration, is given, the frame must have it.

    Raises DataError that names the fluoroscope, the frame and the first wrong target: for an empty
    frame, arrays of different lengths, values that are not finite, a sigma that is not positive, a
    point off the image, a repeated or unknown target, or another image size.
    """
    error = _frame_error(frame, phantom, image_size)
    if error:
        raise DataError(f'fluoroscope {frame.fluoroscope}, frame {frame.number}: {error}')


def _frame_error(frame: Frame, phantom: Phantom | None, image_size: tuple[int, int] | None) -> str:
    """Return the first error of a frame, '' for a valid frame."""
    ids = np.asarray(frame.target_id)
    uv = np.asarray(frame.uv)
    width, height = frame.image_size
    if width <= 0 or height <= 0:
        return f'the image size is {width} x {height} px'
    if image_size is not None:
        error = image_size_error(frame.image_size, image_size)
        if error:
            return error
    if len(ids) == 0:
        return 'the frame is empty, it has no targets'
    if uv.shape != (len(ids), 2):
        return f'{len(ids)} target ids, but image points of shape {uv.shape}'
    if frame.sigma is not None and len(frame.sigma) != len(ids):
        return length_error(ids, sigma=frame.sigma)
    finite = np.asarray(np.isfinite(uv).all(axis=1))
    on_image = points_on_image(uv, frame.image_size)
    known = np.full(len(ids), True) if phantom is None else phantom.index(ids) >= 0
    outside = f'target {{}} is outside the image of {width} x {height} px'
    return (
        angle_error(frame.angle)
        or _first_error(ids, finite, 'the image point of target {} is not a number')
        or ('' if frame.sigma is None else sigma_error(ids, frame.sigma))
        or _first_error(ids, on_image, outside)
        or repeated_target_error(ids)
        or _first_error(ids, np.asarray(known), 'target {} is not on the phantom')
    )


def angle_in_degrees(angle: float) -> float:
    """Convert an angle [rad] to degrees, rounded to a microdegree."""
    return float(np.round(np.degrees(angle), 6))


def angle_error(angle: float | None) -> str:
    """Return the error of an angle of the C-arm [rad], '' for a valid or unknown one."""
    if angle is None or abs(angle) <= MAX_ANGLE:
        return ''
    return f'the angle of the C-arm is {np.degrees(angle):g} degrees'


def angles_of(frames: Iterable[Frame]) -> NDArray[np.float64]:
    """Return the angles (e,) of the C-arm [rad], NaN if unknown."""
    return np.array([np.nan if f.angle is None else f.angle for f in frames], dtype=float)


def points_on_image(uv: ArrayLike, image_size: ArrayLike) -> NDArray[np.bool_]:
    """Return (n,) whether pixels (n, 2) lie on the image, or each on its own (n, 2).

    Pixel centres are at integers; NaN is off the image.
    """
    uv = np.asarray(uv)
    inside = (uv >= -0.5) & (uv <= np.asarray(image_size) - 0.5)
    return np.all(inside, axis=1)


def length_error(target_id: Sized, **arrays: Sized) -> str:
    """Return the error of the first array, by name, whose length differs from target_id."""
    for name, values in arrays.items():
        if len(values) != len(target_id):
            return f'{len(target_id)} target ids, but {len(values)} values of {name}'
    return ''


def image_size_error(
    image_size: tuple[int, int], expected: tuple[int, int], of: str = 'the calibration is for'
) -> str:
    """Return the error of an image size (width, height) that differs from an expected one."""
    if tuple(image_size) == tuple(expected):
        return ''
    return (
        f'the image is {image_size[0]} x {image_size[1]} px, '
        f'but {of} {expected[0]} x {expected[1]} px'
    )


def sigma_error(target_id: ArrayLike, sigma: ArrayLike) -> str:
    """Return the error of the first target whose sigma is not a positive number."""
    ids = np.asarray(target_id)
    return _first_error(ids, is_positive(sigma), 'sigma of target {} is not a positive number')


def repeated_target_error(target_id: ArrayLike) -> str:
    """Return the error of the smallest id that occurs more than once."""
    repeated = first_repeated(target_id)
    if repeated is None:
        return ''
    ids = np.asarray(target_id)
    target = ids[repeated[0]]
    return f'target {target} occurs {np.count_nonzero(ids == target)} times'


def stack_image_points(
    target_id: ArrayLike, u: ArrayLike, v: ArrayLike, sigma: ArrayLike
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64] | None]:
    """Return ids (n,), uv (n, 2) and sigma (n,) of a Frame from the flat arrays of a message.

    An empty sigma becomes None, unknown. Raises DataError for arrays of different lengths.
    """
    ids = np.array(target_id)
    columns = {'u': np.array(u), 'v': np.array(v)}
    deviations = np.array(sigma)
    given = {'sigma': deviations} if len(deviations) else {}
    error = length_error(ids, **columns, **given)
    if error:
        raise DataError(error)
    uv = np.column_stack([columns['u'], columns['v']]).astype(float)
    return ids.astype(np.int64), uv, deviations.astype(float) if len(deviations) else None


def _first_error(ids: NDArray[np.int64], valid: NDArray[np.bool_], error: str) -> str:
    """Return the error of the first target that is not valid (n,), '' if all are."""
    return '' if valid.all() else error.format(ids[~valid][0])


def cells_of(uv: ArrayLike, image_size: ArrayLike, count: int) -> NDArray[np.int64]:
    """Return column and row (n, 2) of image points in a grid of count x count cells.

    Points off the image belong to the nearest cell.
    """
    cell = (np.asarray(uv, dtype=float) + 0.5) / np.asarray(image_size) * count
    return np.clip(np.floor(cell), 0, count - 1).astype(np.int64)


# Targets whose coordinates are known in every exposure, such as motion capture markers.


@dataclass(frozen=True)
class MovingPoints:
    """Coordinates of targets that differ between exposures, in the frame of the lab.

    Raises DataError for a negative exposure or target id, and for ids that cannot be unique.

    Parameters
    ----------
    exposure, target_id : (n,) ndarray of int
    xyz_mm : (n, 3) ndarray
        Coordinates [mm].
    sd_mm : (n,) ndarray
        Standard deviation of each coordinate [mm].
    """

    __repr__ = brief_repr

    exposure: NDArray[np.int64]
    target_id: NDArray[np.int64]
    xyz_mm: NDArray[np.float64]
    sd_mm: NDArray[np.float64]

    def __post_init__(self) -> None:
        for name in ('exposure', 'target_id'):
            numbers = np.asarray(getattr(self, name), dtype=np.int64)
            if (numbers < 0).any():
                raise DataError(f'moving points: {name} is {numbers.min()}, it must be 0 or above')
            object.__setattr__(self, name, numbers)
        exposure = int(self.exposure.max(initial=0))
        if (exposure + 1) * self.base > MAX_ID:
            raise DataError(
                f'moving points: the ids of exposure {exposure} exceed {MAX_ID}: number the '
                'exposures from 1 on, or give the targets smaller ids'
            )

    @property
    def base(self) -> int:
        """Power of ten that separates the ids of successive exposures."""
        return int(10 ** len(str(int(self.target_id.max(initial=0)))))

    def ids(self, exposure: ArrayLike, target_id: ArrayLike) -> NDArray[np.int64]:
        """Return a unique id (n,) for each target of each exposure.

        Target 7 of exposure 12 is 1207 if all ids have at most two digits.
        """
        return np.asarray(exposure, dtype=np.int64) * self.base + np.asarray(target_id)

    def as_phantom(self, frames: Frames) -> tuple[dict[str, list[Frame]], Phantom]:
        """Return frames and phantom in which each target of each exposure has a unique id.

        Raises DataError for a target whose coordinates in an exposure are missing, and for
        coordinates that do not make a valid phantom.
        """
        phantom = Phantom(self.ids(self.exposure, self.target_id), self.xyz_mm, self.sd_mm)
        renumbered: dict[str, list[Frame]] = {}
        for name, view_frames in frames.items():
            renumbered[name] = []
            for frame in view_frames:
                ids = self.ids(frame.number, frame.target_id)
                known = (phantom.index(ids) >= 0) & (np.asarray(frame.target_id) < self.base)
                if not known.all():
                    raise DataError(
                        f'fluoroscope {name}, exposure {frame.number}: the coordinates of target '
                        f'{np.asarray(frame.target_id)[~known][0]} are not given'
                    )
                renumbered[name].append(replace(frame, target_id=ids))
        return renumbered, phantom


MIN_TOGETHER = 4  # minimum number of targets at the same image point to be fill values
MIN_SHARE_TOGETHER = 0.02  # as a share of the targets of the frame; the larger one applies
MAX_SHARE = 0.05  # maximum share of image points of a frame to exclude; one may always be


def few(count: int, of: int) -> bool:
    """Return whether `count` of `of` image points of a frame or file may be excluded."""
    return 0 < count <= max(1, MAX_SHARE * of) and count < of


def without_strays(frame: Frame, phantom: Phantom | None = None) -> tuple[Frame, Finding | None]:
    """Exclude a few stray points of a frame; return the frame, and a finding or None.

    phantom: its targets are known; by default all targets are. A frame with many stray points, or
    with arrays of different lengths, is returned unchanged.
    """
    ids = np.asarray(frame.target_id)
    uv = np.asarray(frame.uv)
    if uv.shape != (len(ids), 2) or (frame.sigma is not None and len(frame.sigma) != len(ids)):
        return frame, None
    finite = np.isfinite(uv).all(axis=1)
    coincident = finite & _together(uv)
    off_image = finite & ~coincident & ~points_on_image(uv, frame.image_size)
    off_phantom = np.zeros(len(ids), dtype=bool) if phantom is None else phantom.index(ids) < 0
    single_stray = (off_image | off_phantom) & ~coincident
    if not few(int(single_stray.sum()), int(np.sum(~coincident))):
        single_stray = np.zeros(len(ids), dtype=bool)
    stray = single_stray | coincident
    if not stray.any() or stray.all():
        return frame, None
    causes = [
        f'target {first_few(ids[mask])} {cause}'
        for mask, cause in (
            (off_image & single_stray, 'outside the image'),
            (off_phantom & single_stray & ~off_image, 'not on the phantom'),
            (
                coincident,
                'at the same image point as others, a fill value for targets that are not seen',
            ),
        )
        if mask.any()
    ]
    count = int(stray.sum())
    return frame.rows(~stray), Finding(
        Kind.STRAY_POINTS,
        f'{count} image point{"s" * (count > 1)}, {" and ".join(causes)}',
        replace(frame.place, target_id=tuple(ids[stray].tolist())),
        severity=Severity.NOTE,
        numbers={
            'off_image': int(np.sum(off_image & single_stray)),
            'not_on_phantom': int(np.sum(off_phantom & single_stray & ~off_image)),
            'fill_values': int(coincident.sum()),
        },
    )


def frames_without_strays(
    frames: Frames, phantom: Phantom
) -> tuple[dict[str, list[Frame]], list[Finding]]:
    """Exclude a few stray points of the frames; return the frames by fluoroscope and findings."""
    findings = []
    clean_frames: dict[str, list[Frame]] = {}
    for name, view_frames in frames.items():
        cleaned = [without_strays(frame, phantom) for frame in view_frames]
        clean_frames[name] = [frame for frame, _ in cleaned]
        findings += [finding for _, finding in cleaned if finding is not None]
    return clean_frames, findings


def _together(uv: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (n,) which image points (n, 2) coincide with enough others to be fill values."""
    if len(uv) < MIN_TOGETHER:
        return np.zeros(len(uv), dtype=bool)
    _, inverse, count = np.unique(uv, axis=0, return_inverse=True, return_counts=True)
    return count[inverse.reshape(-1)] >= max(MIN_TOGETHER, MIN_SHARE_TOGETHER * len(uv))


Frames = Mapping[str, Sequence[Frame]]  # by fluoroscope
