# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Single image points that cannot be used: off the image, or of a target that is unknown.

A few of them are excluded and reported. Many are a fault of the whole input, such as a wrong image
size or another phantom, and are left to `validate_frame`, which refuses the frame. Many targets at
the same image point are a fill value of some program for targets that are not seen, such as
(0, 0), and always excluded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..findings import Finding, Kind, Severity, first_few
from .frame import Frame, points_on_image
from .phantom import Phantom

MIN_TOGETHER = 4  # targets at the same image point that are fill values
MIN_SHARE_TOGETHER = 0.02  # the same, of the targets of the frame; the larger of both holds
MAX_SHARE = 0.05  # of the image points of a frame that are excluded; one always is


def few(count: int, of: int) -> bool:
    """Return whether so many image points of a frame or file can be excluded."""
    return 0 < count <= max(1, MAX_SHARE * of) and count < of


def without_strays(frame: Frame, phantom: Phantom | None = None) -> tuple[Frame, Finding | None]:
    """Return the frame without its few stray points, and a finding about them, None without any.

    phantom: its targets are known, by default all. A frame with many of them, or whose arrays do
    not belong together, is returned as it is.
    """
    ids = np.asarray(frame.target_id)
    uv = np.asarray(frame.uv)
    if uv.shape != (len(ids), 2) or (frame.sigma is not None and len(frame.sigma) != len(ids)):
        return frame, None
    finite = np.isfinite(uv).all(axis=1)
    together = finite & _together(uv)
    off = finite & ~together & ~points_on_image(uv, frame.image_size)
    unknown = np.zeros(len(ids), dtype=bool) if phantom is None else phantom.index(ids) < 0
    single = (off | unknown) & ~together
    if not few(int(single.sum()), int(np.sum(~together))):
        single = np.zeros(len(ids), dtype=bool)
    stray = single | together
    if not stray.any() or stray.all():
        return frame, None
    kept = ~stray
    cleaned = replace(
        frame,
        target_id=ids[kept],
        uv=uv[kept],
        sigma=None if frame.sigma is None else np.asarray(frame.sigma)[kept],
    )
    causes = [
        f'target {first_few(ids[chosen])} {cause}'
        for chosen, cause in (
            (off & single, 'off the image'),
            (unknown & single & ~off, 'not on the phantom'),
            (
                together,
                'at the image point of others, a fill value for targets that are not seen',
            ),
        )
        if chosen.any()
    ]
    count = int(stray.sum())
    return cleaned, Finding(
        Kind.STRAY_POINTS,
        f'{count} image point{"s" * (count > 1)}, {" and ".join(causes)}',
        replace(frame.place, target_id=tuple(ids[stray].tolist())),
        severity=Severity.NOTE,
        numbers={
            'off_image': int(np.sum(off & single)),
            'not_on_phantom': int(np.sum(unknown & single & ~off)),
            'fill_values': int(together.sum()),
        },
    )


def frames_without_strays(
    frames: Mapping[str, Sequence[Frame]], phantom: Phantom
) -> tuple[dict[str, list[Frame]], list[Finding]]:
    """Return the frames by fluoroscope without their few stray points, and findings on these."""
    findings = []
    out: dict[str, list[Frame]] = {}
    for name, exposures in frames.items():
        cleaned = [without_strays(frame, phantom) for frame in exposures]
        out[name] = [frame for frame, _ in cleaned]
        findings += [found for _, found in cleaned if found is not None]
    return out, findings


def _together(uv: np.ndarray) -> np.ndarray:
    """Which (n,) of image points (n, 2) are at the place of so many others that none is there."""
    if len(uv) < MIN_TOGETHER:
        return np.zeros(len(uv), dtype=bool)
    _, place, count = np.unique(uv, axis=0, return_inverse=True, return_counts=True)
    return count[place.reshape(-1)] >= max(MIN_TOGETHER, MIN_SHARE_TOGETHER * len(uv))
