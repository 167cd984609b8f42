# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tracking files (.tra) of Autoscoper: a row a frame, 16 columns a body, NaN without pose.

The layout is that of `save_tracking_results` of Autoscoper with its default options: matrices by
rows (r11, r12, r13, t1, r21, and so on, 0, 0, 0, 1), with commas, in mm, without header. Row 1 is
the first frame. A matrix takes a volume to the world. Autoscoper places a volume by its first
voxel and its own axes, which are not those of the CT from which the markers of a body are.
"""

from __future__ import annotations

from pathlib import Path

from ..access import atomic_file
from .content import Content, FileSettings, Format, Sample, Written, homogeneous
from .frames_of_points import bodies_of, frames_of
from .text import joined


def recognise(sample: Sample) -> bool:
    """Return whether the suffix is that of tracking files."""
    return sample.suffix == '.tra'


def write(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write the poses of bodies, in all frames from the first to the last. Raises DataError."""
    assert content.bodies is not None
    mm, notes = settings.unit_or('mm', str(path))
    frames = frames_of(path, [content.bodies], settings, needs_rate=False)
    matrices = homogeneous(bodies_of(content.bodies, frames), mm)
    with atomic_file(path, 'w') as file:
        file.writelines(joined(of_frame.ravel()) + '\n' for of_frame in matrices)
    order = f'{path}: row 1 is frame {frames.first}, bodies are {", ".join(content.bodies.names)}'
    return Written((str(path),), (*notes, order))


FORMAT = Format(
    'autoscoper',
    'Autoscoper tracking',
    parts=('bodies',),
    recognise=recognise,
    read=None,
    write=write,
    looks_like='rows of 16 numbers a body',
    says_units=False,
)
