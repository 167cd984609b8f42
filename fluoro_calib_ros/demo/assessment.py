# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Processes of the demonstration, and the accuracy of its live results against the true rig."""

from __future__ import annotations

import json
import os
import socket
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..correction.fluoroscope_calibration import Calibrations
from ..photogrammetry.collinearity import project
from ..photogrammetry.rotations import matrix_from_quaternion
from ..processes import Programs
from ..simulation.rig import DistortionField

# UDP port of the first participant of a ROS domain (DDSI-RTPS 2.5, section 9.6.1.1).
DISCOVERY_PORT = 7400
PORTS_PER_DOMAIN = 250
FIRST_PARTICIPANT = 10  # offset of the unicast ports of a domain


class NodeProcesses(Programs):
    """Node processes that end together; a context manager.

    log_directory: folder for the output of each node, NAME.log. namespace: namespace of the nodes;
    if given, the log is NAMESPACE_NAME.log.
    """

    def __init__(self, log_directory: Path, namespace: str = '') -> None:
        super().__init__()
        self._directory = log_directory
        self._namespace = namespace

    def start(
        self, name: str, parameters: Mapping[str, object] | None = None
    ) -> subprocess.Popen[Any]:
        """Start the node fluoro_calib_ros.nodes.NAME with parameters; return the process."""
        arguments = ['--ros-args']
        for key, value in (parameters or {}).items():
            arguments += ['-p', f'{key}:={value}']
        if self._namespace:
            arguments += ['-r', f'__ns:=/{self._namespace}']
        log_name = '_'.join(filter(None, (self._namespace, name)))
        return self.run(
            f'fluoro_calib_ros.nodes.{name}',
            *arguments,
            log=self._directory / f'{log_name}.log',
        )


def isolate_ros_graph() -> None:
    """Restrict this process and its children to this machine and a free ROS domain.

    Environment variables that are already set remain unchanged.
    """
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    if 'ROS_DOMAIN_ID' not in os.environ:
        domains = [1 + (os.getpid() + i) % 100 for i in range(100)]
        free_domain = next((domain for domain in domains if _is_free(domain)), domains[0])
        os.environ['ROS_DOMAIN_ID'] = str(free_domain)


def _is_free(domain: int) -> bool:
    """Return whether no process on this machine uses a ROS domain."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        try:
            port.bind(('', DISCOVERY_PORT + PORTS_PER_DOMAIN * domain + FIRST_PARTICIPANT))
        except OSError:
            return False
    return True


# Frames and source timestamps [ns] by (fluoroscope, frame number); frames have target_id, u and v.
Frames = Mapping[tuple[str, int], tuple[Any, int]]
IMAGE_CENTRE = 511.5  # [px], for images of the virtual rig
IMAGE_SCALE = 512.0


@dataclass(frozen=True)
class SpaceFigures:
    """Accuracy and latency of reconstructed points."""

    rmse_mm: float  #: against the true markers, after the best-fitting rotation and shift
    normalised: float  #: mean ratio of the squared error of a coordinate to its variance
    good_fraction: float  #: fraction of points that were intersected
    exposures: int
    #: median, from publication of the frames by the player to publication of the points
    latency_ms: float


def latencies_ms(sent: Frames, corrected: Frames) -> NDArray[np.float64]:
    """Return the latency of every corrected frame [ms].

    It is the time from publication of the frame by the player to publication of its correction.
    """
    return np.array([(corrected[key][1] - sent[key][1]) * 1e-6 for key in corrected])


def image_errors(
    bags: Path, names: Sequence[str], sent: Frames, corrected: Frames
) -> dict[str, tuple[float, float]]:
    """Return the RMSE of the observed and of the corrected markers by fluoroscope [px].

    A calibration is determined up to a rotation of the sensor and the corresponding change of the
    interior orientation. Therefore a projective map from the image to the truth is fitted first,
    for both observed and corrected markers.
    """
    rig = json.loads((bags / 'truth' / 'rig.json').read_text())['fluoroscopes']
    truth = _true_markers(bags)
    errors = {}
    for name in names:
        observed = []
        undistorted = []
        points = []
        for (fluoroscope, number), (frame, _) in corrected.items():
            if fluoroscope == name:
                source = sent[name, number][0]
                observed.append(np.stack([source.u, source.v], axis=1))
                undistorted.append(np.stack([frame.u, frame.v], axis=1))
                points += [truth[number, i] for i in frame.target_id]
        ideal = _ideal_projection(rig[name], np.array(points))
        errors[name] = (
            projective_lack_of_fit(np.concatenate(observed), ideal),
            projective_lack_of_fit(np.concatenate(undistorted), ideal),
        )
    return errors


def calibration_errors(bags: Path, calibrations: Calibrations) -> dict[str, float]:
    """Return the RMSE of the true markers, observed without noise and corrected [px].

    By fluoroscope, after the best projective map as in image_errors().
    """
    rig = json.loads((bags / 'truth' / 'rig.json').read_text())['fluoroscopes']
    points = np.array(list(_true_markers(bags).values()))
    errors = {}
    for name, calibration in calibrations.items():
        ideal = _ideal_projection(rig[name], points)
        distortion = rig[name]['distortion']
        field = DistortionField(
            np.array(distortion['centre']),
            distortion['pincushion'],
            np.array(distortion['s_shape']),
            distortion['spiral'],
            np.array(distortion['ripples']),
        )
        observed = field.distort(ideal)
        u, v, *_ = calibration.correct_arrays(observed[:, 0], observed[:, 1])
        errors[name] = projective_lack_of_fit(np.column_stack([u, v]), ideal)
    return errors


def space_figures(
    bags: Path, points: Sequence[tuple[Any, int]], sent: Frames, first: str
) -> SpaceFigures:
    """Return the accuracy and latency of reconstructed points.

    Parameters
    ----------
    bags : Path
        Folder of the bags with their truth.
    points : sequence of (GoodPoints, int)
        Points and their source timestamps [ns].
    sent : mapping
        Frames published by the player.
    first : str
        First fluoroscope, whose frame numbers the points have.
    """
    truth = _true_markers(bags)
    true_mm = [truth[p.frame_number, i] for p, _ in points for i in p.target_id]
    measured = np.concatenate([p.xyz_mm for p, _ in points])
    covariance = np.concatenate([p.covariance for p, _ in points])
    error = _error_after_rigid_fit(measured, np.array(true_mm))
    weighted = np.einsum('ni,nij,nj->n', error, np.linalg.inv(covariance), error)
    latency = [
        (stamp - sent[first, p.frame_number][1]) * 1e-6
        for p, stamp in points
        if (first, p.frame_number) in sent
    ]
    return SpaceFigures(
        rmse_mm=float(np.sqrt((error**2).sum(axis=1).mean())),
        normalised=float(weighted.mean() / 3),
        good_fraction=len(measured) / sum(p.total for p, _ in points),
        exposures=len(points),
        latency_ms=float(np.median(latency)),
    )


def projective_lack_of_fit(uv: NDArray[np.float64], ideal: NDArray[np.float64]) -> float:
    """Return the RMSE of a coordinate after the best projective map of uv (n, 2) to ideal [px]."""
    x, y = (uv - IMAGE_CENTRE).T / IMAGE_SCALE
    u, v = (ideal - IMAGE_CENTRE).T / IMAGE_SCALE
    ones = np.ones_like(x)
    zeros = np.zeros_like(x)
    rows = np.concatenate(
        [
            np.stack([x, y, ones, zeros, zeros, zeros, -u * x, -u * y], axis=1),
            np.stack([zeros, zeros, zeros, x, y, ones, -v * x, -v * y], axis=1),
        ]
    )
    h, *_ = np.linalg.lstsq(rows, np.concatenate([u, v]), rcond=None)
    h = np.append(h, 1.0).reshape(3, 3)
    mapped = np.stack([x, y, ones], axis=1) @ h.T
    residual = IMAGE_SCALE * (mapped[:, :2] / mapped[:, 2:] - np.stack([u, v], axis=1))
    return float(np.sqrt(np.mean(residual**2)))


def _true_markers(bags: Path) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Return the true positions [mm] by (frame, target)."""
    rows = np.loadtxt(bags / 'truth' / 'markers.csv', delimiter=',', skiprows=1)
    return {(int(row[0]), int(row[1])): row[2:] for row in rows}


def _ideal_projection(true: Mapping[str, Any], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the undistorted image points (n, 2) of points (n, 3) in a true fluoroscope."""
    n = len(points)
    return project(
        np.broadcast_to(matrix_from_quaternion(true['quaternion_wxyz']), (n, 3, 3)),
        np.broadcast_to(true['position_mm'], (n, 3)),
        points,
        np.array([true['interior'][key] for key in ('xp', 'yp', 'c')]),
    )


def _error_after_rigid_fit(
    measured: NDArray[np.float64], true: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return measured - true (n, 3) after the best rotation and shift of true (Kabsch)."""
    a = measured - measured.mean(axis=0)
    b = true - true.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    return a - b @ (u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt).T
