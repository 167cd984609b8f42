"""The virtual dual fluoroscope: where everything stands, and what is seen.

Two fluoroscopes look across each other at the middle of the rig frame (z up, mm). Their sources
are about 1.5 m from it and about 2 m apart. The phantom is a cube of 260 mm with 503 beads on its
four side faces.
"""

from dataclasses import dataclass

import numpy as np

from ..exposures.frame import Frame, points_on_image
from ..exposures.phantom import Phantom
from ..photogrammetry.collinearity import project
from ..photogrammetry.rotations import matrix_from_vector
from .distortion import DistortionField, random_field

IMAGE_SIZE = (1024, 1024)
CUBE_MM = 260.0
BEADS = 503
SURVEY_SD_MM = 0.1
# of an observed pixel, as target extraction writes it; also hides last-bit differences of CPUs
DECIMALS = 4
START_NS = 1_767_225_600_000_000_000  # stamp of the first frame [ns]
FRAME_ID = '{}_optical'
CLUSTER = 6  # markers of a rigid cluster
BETWEEN_DEG = 84.0  # angle between the axes of neighbouring fluoroscopes
GRID = (52, 39)  # points of a calibration grid across and down


@dataclass(frozen=True)
class VirtualFluoroscope:
    """A fluoroscope: interior (3,) xp, yp, c [px], rotation (3, 3) rig -> sensor, position_mm (3,)
    in the rig frame, and its distortion.
    """

    name: str
    interior: np.ndarray
    rotation: np.ndarray
    position_mm: np.ndarray
    distortion: DistortionField
    image_size: tuple = IMAGE_SIZE

    def exterior(self, pose):
        """Rotation (3, 3) phantom -> sensor and source (3,) in the phantom's frame [mm] for a pose
        of it.
        """
        rotation, shift = pose
        return self.rotation @ rotation, rotation.T @ (self.position_mm - shift)

    def ideal(self, points_mm):
        """Undistorted image points (n, 2) [px] of points (n, 3) in the rig frame [mm]."""
        n = len(points_mm)
        return project(
            np.broadcast_to(self.rotation, (n, 3, 3)),
            np.broadcast_to(self.position_mm, (n, 3)),
            points_mm,
            self.interior,
        )


@dataclass(frozen=True)
class VirtualRig:
    """A rig: fluoroscopes, the phantom's true coordinates [mm] and its survey."""

    fluoroscopes: tuple
    true_mm: np.ndarray
    phantom: Phantom


@dataclass(frozen=True)
class SimulatedExposures:
    """Exposures of the phantom: frames by fluoroscope, poses (rotation, shift [mm]) in the rig
    frame, and by fluoroscope the undistorted points (n, 2) of each frame, noise and false matches
    in them.
    """

    frames: dict
    poses: list
    undistorted: dict


def bead_coordinates(rng):
    """Coordinates (503, 3) [mm] of beads on the four side faces of the cube, in a disturbed 11 x
    12 grid.
    """
    across, up = np.meshgrid(
        (np.arange(11) - 5) * 23.0, (np.arange(12) - 5.5) * 21.0, indexing='ij'
    )
    face = np.column_stack([across.ravel(), up.ravel()])
    beads = []
    for side in range(4):
        keep = np.sort(rng.permutation(len(face))[: 126 if side < BEADS % 4 else 125])
        flat = face[keep] + rng.uniform(-3, 3, (len(keep), 2))
        turn = matrix_from_vector([0, 0, side * np.pi / 2])
        beads.append(
            np.column_stack([flat[:, 0], np.full(len(flat), CUBE_MM / 2), flat[:, 1]]) @ turn.T
        )
    return np.round(np.concatenate(beads), 6)


def looking_at_origin(position_mm):
    """Rotation (3, 3) rig -> sensor of a source at position_mm (3,) that looks at the origin, y
    down.
    """
    z = -np.asarray(position_mm) / np.linalg.norm(position_mm)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def virtual_rig(
    seed=0, strength=1.0, names=('a', 'b'), survey_sd_mm=SURVEY_SD_MM, between_deg=BETWEEN_DEG
):
    """A rig drawn at random: the same seed gives the same rig; strength scales the distortion.

    Of any number of fluoroscopes (names) each looks across the next one by between_deg, some 2 m
    apart at 84; of three, 60 leaves every two of them a good base.
    """
    rng = np.random.default_rng([seed, 1])
    true_mm = bead_coordinates(rng)
    survey = np.round(true_mm + rng.normal(0, survey_sd_mm, true_mm.shape), 4)
    phantom = Phantom(np.arange(1, BEADS + 1), survey, np.full(BEADS, survey_sd_mm))
    fluoroscopes = []
    for number, name in enumerate(names):
        angle = np.deg2rad(between_deg / 2) * (2 * number - (len(names) - 1)) + rng.uniform(
            -0.03, 0.03
        )
        position = 1500 * np.array([np.sin(angle), -np.cos(angle), 0]) + rng.uniform(-30, 30, 3)
        tilt = matrix_from_vector(rng.uniform(-0.01, 0.01, 3))
        interior = np.array([511.5, 511.5, 4000.0]) + rng.uniform([-15, -15, -150], [15, 15, 150])
        fluoroscopes.append(
            VirtualFluoroscope(
                name,
                interior,
                tilt @ looking_at_origin(position),
                position,
                random_field(rng, strength),
            )
        )
    return VirtualRig(tuple(fluoroscopes), true_mm, phantom)


def phantom_poses(rng, count):
    """Poses (rotation, shift [mm]) of the phantom: round the turntable, tilted and moved about the
    rig.
    """
    turns = 2 * np.pi * (np.arange(count) + rng.uniform(0, 1, count)) / count
    poses = []
    for turn in turns:
        tilt = matrix_from_vector(np.append(rng.uniform(-0.35, 0.35, 2), 0))
        poses.append(
            (tilt @ matrix_from_vector([0, 0, turn]), rng.uniform([-80, -80, -70], [80, 80, 70]))
        )
    return poses


def simulate_exposures(
    rig,
    count,
    seed=0,
    noise_px=0.25,
    false_matches=0.01,
    matched=(130, 160),
    interval_s=0.5,
    start_ns=START_NS,
    first_number=1,
):
    """Exposures of the phantom in count poses: SimulatedExposures.

    matched: range of the number of beads found in an exposure; false_matches: part of them that
    bear the id of a bead nearby; the exposures are interval_s [s] apart.
    """
    rng = np.random.default_rng([seed, 2])
    poses = phantom_poses(rng, count)
    frames = {f.name: [] for f in rig.fluoroscopes}
    undistorted = {f.name: [] for f in rig.fluoroscopes}
    for j, (rotation, shift) in enumerate(poses):
        stamp = start_ns + round(j * interval_s * 1e9)
        points = rig.true_mm @ rotation.T + shift
        for fluoroscope in rig.fluoroscopes:
            ids, observed = seen_beads(
                rng, fluoroscope, points, rig.phantom.target_id, noise_px, false_matches, matched
            )
            frames[fluoroscope.name].append(
                Frame(
                    fluoroscope.name,
                    first_number + j,
                    ids,
                    observed,
                    fluoroscope.image_size,
                    None,
                    stamp,
                    FRAME_ID.format(fluoroscope.name),
                )
            )
            undistorted[fluoroscope.name].append(observed - fluoroscope.distortion(observed))
    return SimulatedExposures(frames, poses, undistorted)


def seen_beads(rng, fluoroscope, points, target_id, noise_px, false_matches, matched):
    """Ids (n,) and observed pixels (n, 2) of the beads that are found in one exposure."""
    ideal = fluoroscope.ideal(points)
    observed = fluoroscope.distortion.distort(ideal) + rng.normal(0, noise_px, ideal.shape)
    visible = np.flatnonzero(points_on_image(observed, fluoroscope.image_size))
    found = np.sort(rng.permutation(visible)[: rng.integers(matched[0], matched[1] + 1)])
    seen = np.round(observed[found], DECIMALS)
    for row in np.flatnonzero(rng.random(len(found)) < false_matches):
        distance = np.sum((observed[visible] - observed[found[row]]) ** 2, axis=1)
        wrong = visible[np.argsort(distance, kind='stable')[rng.integers(1, 9)]]
        seen[row] = np.round(observed[wrong], DECIMALS)
    return target_id[found], seen


@dataclass(frozen=True)
class SimulatedTracking:
    """A recording of moving markers: frames by fluoroscope, marker ids (k,), positions (frames, k,
    3) in the rig frame [mm] and by fluoroscope the ideal image points (frames, k, 2) [px] without
    noise.
    """

    frames: dict
    marker_id: np.ndarray
    points_mm: np.ndarray
    ideal: dict


def simulate_tracking(
    rig,
    seconds=4.0,
    rate_hz=120.0,
    seed=0,
    noise_px=0.25,
    start_ns=START_NS,
    first_number=1,
    clusters=4,
):
    """Markers on the two bones of a joint that bends and straightens: up to eight rigid clusters
    of six, of which the first two are on the one bone.
    """
    rng = np.random.default_rng([seed, 3])
    places = np.array(
        [
            [-8, 0, 85],
            [12, 10, 40],
            [-10, -8, -35],
            [10, 5, -80],
            [30, -25, -55],
            [-35, 30, -60],
            [35, 30, -20],
            [-35, -30, -10],
        ],
        dtype=float,
    )[:clusters]
    clusters = [rng.uniform(-22, 22, (CLUSTER, 3)) for _ in places]
    ids = np.arange(1001, 1001 + CLUSTER * len(clusters))
    count = round(seconds * rate_hz)
    points = np.empty((count, len(ids), 3))
    for k in range(count):
        t = k / rate_hz
        bend = np.deg2rad(25) * np.sin(2 * np.pi * 0.5 * t)
        sway = 70 * np.array(
            [np.sin(2 * np.pi * 0.31 * t), np.cos(2 * np.pi * 0.23 * t), 0.6 * np.sin(t)]
        )
        for number, (cluster, place) in enumerate(zip(clusters, places)):
            turn = matrix_from_vector(
                [bend if number < 2 else -bend, 0.3 * np.sin(1.1 * t + number), 0]
            )
            points[k, CLUSTER * number : CLUSTER * (number + 1)] = (
                cluster + place
            ) @ turn.T + sway
    frames = {}
    ideal = {}
    for fluoroscope in rig.fluoroscopes:
        uv = fluoroscope.ideal(points.reshape(-1, 3)).reshape(count, len(ids), 2)
        observed = fluoroscope.distortion.distort(uv.reshape(-1, 2)).reshape(uv.shape)
        observed = np.round(observed + rng.normal(0, noise_px, uv.shape), DECIMALS)
        ideal[fluoroscope.name] = uv
        frames[fluoroscope.name] = [
            Frame(
                fluoroscope.name,
                first_number + k,
                ids,
                observed[k],
                fluoroscope.image_size,
                None,
                start_ns + round(k / rate_hz * 1e9),
                FRAME_ID.format(fluoroscope.name),
            )
            for k in range(count)
        ]
    return SimulatedTracking(frames, ids, points, ideal)


def simulate_grid(rig, count, seed=0, noise_px=0.25, start_ns=START_NS, rate_hz=30.0):
    """Frames {fluoroscope: [Frame, ...]} of a grid of 2,028 points in front of the detector, count
    of each.
    """
    rng = np.random.default_rng([seed, 5])
    frames = {}
    for fluoroscope in rig.fluoroscopes:
        across, down = (
            np.linspace(0.08, 0.92, n) * size for n, size in zip(GRID, fluoroscope.image_size)
        )
        ideal = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
        bent = fluoroscope.distortion.distort(ideal)
        ids = np.arange(2001, 2001 + len(ideal))
        frames[fluoroscope.name] = [
            Frame(
                fluoroscope.name,
                1 + k,
                ids,
                np.round(bent + rng.normal(0, noise_px, bent.shape), DECIMALS),
                fluoroscope.image_size,
                None,
                start_ns + round(k / rate_hz * 1e9),
                FRAME_ID.format(fluoroscope.name),
            )
            for k in range(count)
        ]
    return frames
