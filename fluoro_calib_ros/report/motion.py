# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Figures and report of motion: joints and bodies over time, reconstructed points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..bodies.body import BodyPoses, PoseStatus
from ..bodies.joints import JointMotion
from ..photogrammetry.rotations import vector_from_matrix
from ..reconstruction.intersection import OK
from ..reconstruction.reconstruct import ReconstructedFrame
from .figures import BLUE, GREY, RED, STYLE, new_figure
from .html import page, svg_text

BAND = 2.0  # half width of the band in standard deviations, 95 %
FILLED = 0.15  # opacity of the background of times without a marker


def joint_figure(motion: JointMotion) -> Figure:
    """Return a figure of the angles and translations of a joint."""
    names = [
        *(f'{name.replace("_", " ")} [°]' for name in motion.angle_names),
        *(f'{name.replace("_", " ")} [mm]' for name in motion.translation_names),
    ]
    scale = np.repeat([180 / np.pi, 1.0], 3)
    values = np.hstack([motion.angles, motion.translations]) * scale
    return _series(motion.joint.name, names, motion, (values, motion.sd * scale))


def body_figure(poses: BodyPoses) -> Figure:
    """Return a figure of the position of a body, and its rotation relative to the first pose."""
    known = np.flatnonzero(poses.known)
    names = [
        *(f'{axis} [mm]' for axis in 'xyz'),
        *(f'rotation about {axis} [°]' for axis in 'xyz'),
    ]
    values = np.full((len(poses.number), 6), np.nan)
    values[:, :3] = poses.position_mm
    if len(known):
        rotation = poses.rotation[known] @ poses.rotation[known[0]].T
        values[known, 3:] = np.degrees(vector_from_matrix(rotation))
    sd = poses.sd * np.repeat([1.0, 180 / np.pi], 3)
    return _series(poses.body, names, poses, (values, sd))


def _series(
    title: str,
    names: list[str],
    source: JointMotion | BodyPoses,
    series: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> Figure:
    """Return a figure of six time series (T, 6) with their standard deviations."""
    values, sd = series
    time_s = (source.stamp_ns - source.stamp_ns[0]) / 1e9
    filled = np.isin(source.status, (PoseStatus.FILLED, PoseStatus.FAILED))
    with matplotlib.rc_context(STYLE):
        figure = new_figure(10, 6, title)
        axes = figure.subplots(2, 3, sharex=True)
        for number, (name, panel) in enumerate(zip(names, axes.ravel().tolist())):
            curve, band = values[:, number], BAND * sd[:, number]
            panel.fill_between(
                time_s, curve - band, curve + band, color=RED, alpha=0.3, linewidth=0
            )
            panel.plot(time_s, curve, color=BLUE, linewidth=1.2)
            panel.set_title(name)
            if filled.any():
                panel.fill_between(
                    time_s,
                    0,
                    1,
                    where=filled,
                    transform=panel.get_xaxis_transform(),
                    color=GREY,
                    alpha=FILLED,
                    linewidth=0,
                )
        for panel in axes[1]:
            panel.set_xlabel('time [s]')
        figure.supxlabel(
            f'band: {BAND:g} standard deviations of all errors'
            + ('; grey: predicted, no marker was seen, or no pose' if filled.any() else ''),
            fontsize=9,
        )
    return figure


def paths_figure(poses: Sequence[BodyPoses]) -> Figure:
    """Return a figure of the paths of the origins of bodies, with their axes at ten times."""
    with matplotlib.rc_context(STYLE):
        figure = new_figure(7, 6, 'Paths of the origins of the bodies')
        axes = figure.add_subplot(projection='3d')
        reach = 0.0
        for body_poses in poses:
            known = np.flatnonzero(body_poses.known)
            if len(known):
                axes.plot(*body_poses.position_mm.T, linewidth=2.5, label=body_poses.body)
                reach = max(reach, float(np.ptp(body_poses.position_mm[known], axis=0).max()))
        for body_poses in poses:
            known = np.flatnonzero(body_poses.known)
            for row in known[np.linspace(0, len(known) - 1, 10).astype(int)] if len(known) else ():
                origin = body_poses.position_mm[row]
                for axis, colour in zip(body_poses.rotation[row].T, (RED, GREY, BLUE)):
                    end = origin + (0.1 * reach + 5) * axis
                    axes.plot(*np.stack([origin, end]).T, color=colour, linewidth=0.8)
        axes.set(xlabel='x [mm]', ylabel='y [mm]', zlabel='z [mm]')
        axes.set_aspect('equal')
        if axes.lines:
            axes.legend(loc='upper left')
        figure.supxlabel('axes of the bodies: x red, y grey, z blue', fontsize=9)
    return figure


MAX_NAMED = 30  # up to so many targets the rows are labelled with names


def points_figure(frames: Sequence[ReconstructedFrame], names: Mapping[int, str]) -> Figure:
    """Return a figure of paths of reconstructed points, times of detection, and accuracy."""
    ids = np.unique(np.concatenate([frame.target_id for frame in frames]))
    xyz = np.full((len(frames), len(ids), 3), np.nan)
    sd = np.full(xyz.shape, np.nan)
    for row, frame in enumerate(frames):
        column = np.searchsorted(ids, frame.target_id)
        ok = frame.points.status == OK
        xyz[row, column[ok]] = frame.points.xyz_mm[ok]
        sd[row, column[ok]] = frame.points.sd_mm[ok]
    found = np.isfinite(xyz[..., 0])
    time_s = (np.array([frame.stamp_ns for frame in frames]) - frames[0].stamp_ns) / 1e9
    x = time_s if np.all(np.diff(time_s) > 0) else np.array([f.number for f in frames])
    labels = [names.get(int(i), str(i)) for i in ids]
    with matplotlib.rc_context(STYLE):
        figure = new_figure(14, 7, f'{len(ids)} targets in {len(frames)} frames')
        left, right = figure.subfigures(1, 2, width_ratios=(1, 1.2))
        _draw_paths(left.add_subplot(projection='3d'), xyz)
        gap_axes, sd_axes = right.subplots(1, 2, sharey=True, width_ratios=(3, 1))
        _draw_gaps(gap_axes, x, found, labels)
        gap_axes.set_xlabel('time [s]' if x is time_s else 'frame')
        rows = np.arange(len(ids))
        for axis, colour, shift in zip(range(3), (RED, GREY, BLUE), (-0.25, 0, 0.25)):
            median = [
                np.median(c[np.isfinite(c)]) if np.isfinite(c).any() else 0
                for c in sd[..., axis].T
            ]
            sd_axes.barh(rows + shift, median, 0.25, color=colour, label='xyz'[axis])
        sd_axes.set(xlabel='median sd [mm]', title='sd')
        right.legend(loc='outside lower right', ncols=3)
    return figure


def _draw_paths(axes: Axes, xyz: NDArray[np.float64]) -> None:
    """Draw the paths of points (T, n, 3), with a dot at the end of each."""
    for path in np.swapaxes(xyz, 0, 1):
        (line,) = axes.plot(*path.T, linewidth=1)
        last_point = path[np.isfinite(path[:, 0])][-1:]
        axes.scatter(*last_point.T, s=12, color=line.get_color())
    axes.set(xlabel='x [mm]', ylabel='y [mm]', zlabel='z [mm]', title='paths in space')
    axes.zaxis.labelpad = 10
    if np.isfinite(xyz).any():
        axes.set_aspect('equal')


def _draw_gaps(
    axes: Axes, when: np.ndarray, detected: NDArray[np.bool_], labels: Sequence[str]
) -> None:
    """Draw when targets (T, n) were found, one row a target, with the share of frames."""
    for row, is_found in enumerate(detected.T):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], is_found.astype(int), [0]])))
        step = float(np.median(np.diff(when))) if len(when) > 1 else 1.0
        spans = [
            (when[start], when[stop - 1] + step - when[start])
            for start, stop in zip(edges[::2], edges[1::2])
        ]
        axes.broken_barh(spans, (row - 0.4, 0.8), color=BLUE, linewidth=0)
    shares = 100 * detected.mean(axis=0)
    rows = np.arange(len(labels))
    if len(labels) <= MAX_NAMED:
        axes.set_yticks(rows, [f'{name}: {share:.0f} %' for name, share in zip(labels, shares)])
    axes.set(title='found', ylim=(len(labels) - 0.5, -0.5))


def bodies_html(
    title: str,
    poses: Sequence[BodyPoses],
    joints: Sequence[JointMotion],
    summary: Mapping[str, Any],
    findings: Sequence[str],
) -> str:
    """Return the report as HTML with embedded figures and no external references.

    summary: as in BodiesOutcome.
    """
    figures = [(f'joint {motion.joint.name}', joint_figure(motion)) for motion in joints]
    figures.append(('paths in space', paths_figure(poses)))
    figures += [(f'body {body_poses.body}', body_figure(body_poses)) for body_poses in poses]
    return page(
        'bodies.html',
        title=title,
        exposures=len(poses[0].number),
        findings=findings,
        summary=summary,
        pictures=[(name, svg_text(figure)) for name, figure in figures],
    )
