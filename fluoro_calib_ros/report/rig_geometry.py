# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Geometry of the rig of a calibration [mm], and the accuracy of 3-D points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..correction.fluoroscope_calibration import Calibrations, FluoroscopeCalibration
from ..exposures.phantom import Phantom
from ..photogrammetry.rig_orientation import RigOrientation
from ..photogrammetry.rotations import matrix_from_quaternion
from ..reconstruction.intersection import OK
from ..reconstruction.reconstruct import ReconstructedFrame

BEHIND = 1.3  # position of the image plane in the drawing, as a multiple of the phantom distance
GRID = 64  # number of sample points in each direction of an image


@dataclass(frozen=True)
class SpaceAccuracy:
    """Accuracy of 3-D points that at least two fluoroscopes see."""

    points: int  #: number of intersected beads in all exposures
    sd_mm: NDArray[
        np.float64
    ]  #: (3,) median standard deviations of x, y, z in the frame of the rig
    sd_point_mm: float  #: median of the root of the sum of their squares
    distances: int  #: number of distances between beads of the same exposure
    distance_mm: float  #: mean distance
    distance_rms_mm: float  #: RMS of the differences from the survey
    distance_sd_mm: float  #: expected RMS of these differences


def accuracy_in_space(
    frames: Sequence[ReconstructedFrame], phantom: Phantom
) -> SpaceAccuracy | None:
    """Return the accuracy of beads in exposures, None if no exposure has two of them.

    In each exposure, distances are measured between beads of the first and of the second half.
    """
    sd = []
    measured = []
    surveyed = []
    variances = []
    for frame in frames:
        row = phantom.index(frame.target_id)
        ok = (frame.points.status == OK) & (row >= 0)
        sd.append(frame.points.sd_mm[ok])
        half = np.count_nonzero(ok) // 2
        first, second = np.flatnonzero(ok)[: 2 * half].reshape(2, half)
        vector = frame.points.xyz_mm[second] - frame.points.xyz_mm[first]
        length = np.linalg.norm(vector, axis=1)
        covariance = frame.points.covariance_noise[first] + frame.points.covariance_noise[second]
        unit = vector / length[:, None]
        measured.append(length)
        survey_xyz = phantom.xyz_mm[row]
        surveyed.append(np.linalg.norm(survey_xyz[second] - survey_xyz[first], axis=1))
        variances.append(
            np.einsum('ni,nij,nj->n', unit, covariance, unit)
            + phantom.sd_mm[row[first]] ** 2
            + phantom.sd_mm[row[second]] ** 2
        )
    if not sum(map(len, measured)):
        return None
    sds = np.concatenate(sd)
    lengths = np.concatenate(measured)
    difference = lengths - np.concatenate(surveyed)
    return SpaceAccuracy(
        len(sds),
        np.median(sds, axis=0),
        sd_point_mm=float(np.median(np.linalg.norm(sds, axis=1))),
        distances=len(lengths),
        distance_mm=float(lengths.mean()),
        distance_rms_mm=float(np.sqrt(np.mean(difference**2))),
        distance_sd_mm=float(np.sqrt(np.mean(np.concatenate(variances)))),
    )


def beams(orientation: RigOrientation) -> list[tuple[str, float, float]]:
    """Return for each pair of fluoroscopes: names, angle of beams [deg], source distance [mm].

    A beam is the ray through the principal point.
    """
    pairs = []
    for i, j in combinations(range(len(orientation.fluoroscopes)), 2):
        axes = orientation.rotation[[i, j], 2]
        angle = np.arctan2(np.linalg.norm(np.cross(*axes)), axes[0] @ axes[1])
        baseline = orientation.position_mm[i] - orientation.position_mm[j]
        names = f'{orientation.fluoroscopes[i]} and {orientation.fluoroscopes[j]}'
        pairs.append((names, float(np.degrees(angle)), float(np.linalg.norm(baseline))))
    return pairs


def phantom_in_sensor(result: Mapping[str, Any], name: str) -> NDArray[np.float64]:
    """Return the centroids (m, 3) of the targets in the sensor frames of exposures [mm].

    result: content of result.json. name: of a fluoroscope.
    """
    entries = result['fluoroscopes'][name]['exposures']
    xyz = np.array([target['xyz_mm'] for target in result['targets']]).reshape(-1, 3)
    centre = xyz.mean(axis=0) if len(xyz) else np.zeros(3)
    quaternion = np.array([entry['quaternion_wxyz'] for entry in entries], dtype=float)
    position = np.array([entry['position_mm'] for entry in entries], dtype=float)
    rotation = matrix_from_quaternion(quaternion.reshape(-1, 4))
    return (rotation @ (centre - position.reshape(-1, 3))[:, :, None])[:, :, 0]


def phantom_distance(result: Mapping[str, Any], name: str) -> float:
    """Return the median depth of the phantom from the source [mm], NaN without exposures."""
    depth = phantom_in_sensor(result, name)[:, 2]
    return float(np.median(depth)) if len(depth) else float('nan')


def uncalibrated_share(calibration: FluoroscopeCalibration) -> float:
    """Return the fraction of pixels outside the calibrated area, 0 to 1."""
    ticks = ((np.arange(GRID) + 0.5) / GRID * side - 0.5 for side in calibration.image_size)
    uv = np.stack(np.meshgrid(*ticks), axis=-1).reshape(-1, 2)
    return float(np.mean(calibration.model.outside(uv)))


def drawing(
    result: Mapping[str, Any], calibrations: Calibrations, orientation: RigOrientation | None
) -> dict[str, Any]:
    """Return the data of the drawing of the rig [mm], in the rig frame if there is an orientation.

    Otherwise the frame is that of the sensor of the first fluoroscope. The data are sources,
    corners of the images on a plane behind the phantom, and positions of the phantom.
    """
    entries = result['fluoroscopes']
    fluoroscopes = []
    places: list[list[float]] = []
    names = [n for n in (orientation.fluoroscopes if orientation else ()) if n in entries]
    for name in names or list(entries)[:1]:
        calibration = calibrations[name]
        rotation = np.eye(3)
        origin = np.zeros(3)
        if orientation is not None:
            index = orientation.fluoroscopes.index(name)
            rotation = orientation.rotation[index]
            origin = orientation.position_mm[index]
        distance = phantom_distance(result, name)
        depth = BEHIND * (distance if np.isfinite(distance) else 1000.0)
        xp, yp, c = calibration.interior
        width, height = calibration.image_size
        corners = [(0, 0), (width, 0), (width, height), (0, height)]
        rays = np.array([((u - xp) / c, (v - yp) / c, 1.0) for u, v in corners]) * depth
        fluoroscopes.append(
            {
                'name': name,
                'source': origin.tolist(),
                'corners': (rays @ rotation + origin).tolist(),
            }
        )
        if not places:
            places = (phantom_in_sensor(result, name) @ rotation + origin).tolist()
    return {'fluoroscopes': fluoroscopes, 'places': places}
