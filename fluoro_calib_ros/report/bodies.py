# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The report of bodies and joints as one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..bodies.body import BodyPoses
from ..bodies.joints import JointMotion
from .html import page, png_text
from .motion_figure import body_figure, joint_figure, paths_figure


def bodies_html(
    title: str,
    poses: Sequence[BodyPoses],
    joints: Sequence[JointMotion],
    summary: Mapping[str, Any],
    findings: Sequence[str],
) -> str:
    """Return the report as HTML: pictures inside, no reference to anything outside.

    summary: as BodiesOutcome gives it.
    """
    figures = [(f'joint {one.joint.name}', joint_figure(one)) for one in joints]
    figures.append(('paths in space', paths_figure(poses)))
    figures += [(f'body {one.body}', body_figure(one)) for one in poses]
    return page(
        'bodies.html',
        title=title,
        exposures=len(poses[0].number),
        findings=findings,
        summary=summary,
        pictures=[(name, png_text(figure)) for name, figure in figures],
    )
