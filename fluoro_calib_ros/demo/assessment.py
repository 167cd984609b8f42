# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Processes of the demonstration, and the accuracy of its live results against the true rig."""

from __future__ import annotations

import json
import os
import socket
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..bodies.body import fitted_pose
from ..correction.fluoroscope_calibration import Calibrations
from ..nodes.demo_client import DemoClient, DemoError
from ..processes import Programs
from ..simulation.rig import VirtualRig, virtual_rig

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

    def wait(
        self,
        client: DemoClient,
        condition: Callable[[], bool],
        timeout_s: float,
        description: str,
    ) -> None:
        """Let a client wait for a condition. Raises DemoError, also if a node has failed."""
        client.wait(lambda: condition() or self.failed(), timeout_s, description)
        if self.failed():
            raise DemoError(f'a node ended with a fault, see the logs in {self._directory}')


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


@dataclass(frozen=True)
class RecordedRig:
    """The virtual rig with which the bags were made."""

    rig: VirtualRig
    seed: int
    noise_px: float  #: standard deviation of an image coordinate
    exposures: int
    markers: dict[tuple[int, int], NDArray[np.float64]]  #: true positions [mm] by (frame, target)

    @classmethod
    def of(cls, bags: Path, names: Sequence[str]) -> RecordedRig:
        """Return the rig of fluoroscopes described by the truth in a folder of bags."""
        settings = json.loads((bags / 'truth' / 'rig.json').read_text())['made_with']
        rows = np.loadtxt(bags / 'truth' / 'markers.csv', delimiter=',', skiprows=1)
        return cls(
            virtual_rig(settings['seed'], settings['strength'], names),
            seed=settings['seed'],
            noise_px=settings['noise'],
            exposures=settings['exposures'],
            markers={(int(row[0]), int(row[1])): row[2:] for row in rows},
        )


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
    recorded: RecordedRig, sent: Frames, corrected: Frames
) -> dict[str, tuple[float, float]]:
    """Return the RMSE of the observed and of the corrected markers by fluoroscope [px].

    A calibration is determined up to a rotation of the sensor and the corresponding change of the
    interior orientation. Therefore a projective map from the image to the truth is fitted first,
    for both observed and corrected markers.
    """
    errors = {}
    for true in recorded.rig.fluoroscopes:
        name = true.name
        observed = []
        undistorted = []
        points = []
        for (fluoroscope, number), (frame, _) in corrected.items():
            if fluoroscope == name:
                source = sent[name, number][0]
                observed.append(np.stack([source.u, source.v], axis=1))
                undistorted.append(np.stack([frame.u, frame.v], axis=1))
                points += [recorded.markers[number, i] for i in frame.target_id]
        ideal = true.ideal(np.array(points))
        errors[name] = (
            projective_lack_of_fit(np.concatenate(observed), ideal),
            projective_lack_of_fit(np.concatenate(undistorted), ideal),
        )
    return errors


def calibration_errors(recorded: RecordedRig, calibrations: Calibrations) -> dict[str, float]:
    """Return the RMSE of the true markers, observed without noise and corrected [px].

    By fluoroscope, after the best projective map as in image_errors().
    """
    points = np.array(list(recorded.markers.values()))
    errors = {}
    for true in recorded.rig.fluoroscopes:
        ideal = true.ideal(points)
        u, v, *_ = calibrations[true.name].correct_arrays(*true.distortion.distort(ideal).T)
        errors[true.name] = projective_lack_of_fit(np.column_stack([u, v]), ideal)
    return errors


def space_figures(
    recorded: RecordedRig, points: Sequence[tuple[Any, int]], sent: Frames, first: str
) -> SpaceFigures:
    """Return the accuracy and latency of reconstructed points.

    Parameters
    ----------
    recorded : RecordedRig
    points : sequence of (GoodPoints, int)
        Points and their source timestamps [ns].
    sent : mapping
        Frames published by the player.
    first : str
        First fluoroscope, whose frame numbers the points have.
    """
    true_mm = [recorded.markers[p.frame_number, i] for p, _ in points for i in p.target_id]
    measured = np.concatenate([p.xyz_mm for p, _ in points])
    covariance = np.concatenate([p.covariance for p, _ in points])
    rotation, shift = fitted_pose(np.array(true_mm), measured)
    error = measured - (np.array(true_mm) @ rotation.T + shift)
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
