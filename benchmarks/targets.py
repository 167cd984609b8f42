# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Accuracy with flat targets, and with a known orientation: docs/how_good.md has the results.

    python -m benchmarks.targets [--seeds 5] [--case NAME]

Each case calibrates fluoroscope a of a virtual rig from its targets, and adjusts 40 unused
exposures of the phantom with fixed interior orientation and correction. The errors of their object
points and of the correction are compared with those of the same case with known distortion: the
true distortion is removed from the image points, and the interior orientation is estimated from
the same exposures.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from fluoro_calib_ros.estimation.calibrate import calibrate_request
from fluoro_calib_ros.estimation.initial_network import (
    KnownSensor,
    adjusted_with_precision,
    measured_network,
    start_noise,
)
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.exposures.frame import Frame, MovingPoints, points_on_image
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.photogrammetry.rig_orientation import KnownOrientation
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.simulation.rig import (
    Detection,
    Pose,
    VirtualFluoroscope,
    VirtualRig,
    detect_beads,
    simulate_exposures,
    virtual_rig,
)

GRID_IDS = 1000  # first id of the grid
TESTED = 40
TEST_SEED = 77
POINT_SD_MM = 0.1  # for markers with known coordinates
WEAK_SURVEY = 10.0


def grid_points(columns: int = 17, rows: int = 17, spacing_mm: float = 18.0) -> np.ndarray:
    """Return points (n, 3) of a flat grid in the plane z = 0."""
    x, y = np.meshgrid(np.arange(columns), np.arange(rows), indexing='ij')
    middle = np.array([columns - 1, rows - 1]) / 2
    flat = (np.column_stack([x.ravel(), y.ravel()]) - middle) * spacing_mm
    return np.column_stack([flat, np.zeros(len(flat))])


def facing(
    fluoroscope: VirtualFluoroscope,
    rng: np.random.Generator,
    tilt_deg: float,
    depth_mm: float = 0.0,
    shift_mm: float = 60.0,
) -> Pose:
    """Return the pose of a plane before a fluoroscope: rotation and shift [mm] to the rig frame.

    The plane is tilted by an angle about a random axis, and rotated about its normal at random.
    """
    about = rng.uniform(0, 2 * np.pi)
    tilt = matrix_from_vector(np.deg2rad(tilt_deg) * np.array([np.cos(about), np.sin(about), 0]))
    turn = matrix_from_vector([0, 0, rng.uniform(0, 2 * np.pi)])
    in_sensor = np.append(rng.uniform(-shift_mm, shift_mm, 2), depth_mm)
    middle = -fluoroscope.rotation @ fluoroscope.position_mm  # the origin of the rig frame
    place = fluoroscope.rotation.T @ (middle + in_sensor) + fluoroscope.position_mm
    return fluoroscope.rotation.T @ tilt @ turn, place


def grid_frames(
    fluoroscope: VirtualFluoroscope,
    points: np.ndarray,
    poses: Sequence[Pose],
    seed: int,
    detection: Detection | None = None,
) -> list[Frame]:
    """Simulate exposures of a grid."""
    rng = np.random.default_rng([seed, 5])
    ids = GRID_IDS + np.arange(len(points))
    frames = []
    for number, (rotation, shift) in enumerate(poses, 1):
        found, uv = detect_beads(rng, fluoroscope, points @ rotation.T + shift, ids, detection)
        frames.append(Frame(fluoroscope.name, number, found, uv, fluoroscope.image_size))
    return frames


def without_distortion(frames: Sequence[Frame], fluoroscope: VirtualFluoroscope) -> list[Frame]:
    """Return the frames with the true distortion removed."""
    out = []
    for frame in frames:
        uv = frame.uv - fluoroscope.distortion(frame.uv)
        on = points_on_image(uv, frame.image_size)
        out.append(replace(frame, target_id=frame.target_id[on], uv=uv[on]))
    return out


def grid_survey(points: np.ndarray, sd_mm: float = 0.05, seed: int = 0) -> Phantom:
    """Return a Phantom of the grid with survey errors."""
    rng = np.random.default_rng([seed, 6])
    survey = points + rng.normal(0, sd_mm, points.shape)
    return Phantom(GRID_IDS + np.arange(len(points)), survey, np.full(len(points), sd_mm))


def both(one: Phantom, other: Phantom) -> Phantom:
    """Combine the targets of two phantoms, whose ids differ."""
    return Phantom(
        np.concatenate([one.target_id, other.target_id]),
        np.concatenate([one.xyz_mm, other.xyz_mm]),
        np.concatenate([one.sd_mm, other.sd_mm]),
    )


@dataclass(frozen=True)
class Case:
    """Frames, phantom and options of a calibration."""

    frames: list[Frame]
    phantom: Phantom
    options: CalibrationOptions = field(default_factory=CalibrationOptions)
    principal_distance: float | None = None
    known: dict[str, KnownOrientation] = field(default_factory=dict)

    def request(self, frames: Sequence[Frame], **options: Any) -> CalibrationRequest:
        """Return the CalibrationRequest for these frames."""
        return CalibrationRequest(
            {'a': frames},
            self.phantom,
            replace(self.options, **options),
            principal_distance=self.principal_distance,
            known_orientations=self.known,
        )


def tilted_grid(
    rig: VirtualRig, seed: int, count: int = 15, max_tilt: float = 40.0, **detection: Any
) -> Case:
    """Simulate a grid in tilted poses."""
    fluoroscope = rig.fluoroscopes[0]
    rng = np.random.default_rng([seed, 7])
    points = grid_points()
    tilts = rng.uniform(10, max_tilt, count)
    poses = [facing(fluoroscope, rng, t, rng.uniform(-100, 100)) for t in tilts]
    frames = grid_frames(fluoroscope, points, poses, seed, Detection(**detection))
    return Case(frames, grid_survey(points, seed=seed))


def grid_on_intensifier(rig: VirtualRig, seed: int, count: int = 6) -> Case:
    """Simulate a grid that is shifted and rotated on the image intensifier; c is given."""
    fluoroscope = rig.fluoroscopes[0]
    rng = np.random.default_rng([seed, 8])
    points = grid_points(23, 23)
    poses = [facing(fluoroscope, rng, 0.0, 0.0, 20.0) for _ in range(count)]
    frames = grid_frames(fluoroscope, points, poses, seed, Detection(beads=(300, 500)))
    c = float(fluoroscope.interior[2])
    return Case(frames, grid_survey(points, seed=seed), principal_distance=c)


def small_cube(rig: VirtualRig, seed: int, count: int = 15) -> Case:
    """Simulate a cube of half the size, which leaves the rim of the image uncovered."""
    chosen = np.sort(np.random.default_rng([seed, 9]).permutation(len(rig.true_mm))[:64])
    survey = rig.phantom
    true = 0.5 * rig.true_mm[chosen]
    error = (survey.xyz_mm - rig.true_mm)[chosen]
    small = replace(
        rig,
        true_mm=true,
        phantom=Phantom(survey.target_id[chosen], true + error, survey.sd_mm[chosen]),
    )
    frames = simulate_exposures(small, count, seed, Detection(beads=(50, 64))).frames['a']
    return Case(frames, small.phantom)


def cube_and_grid(rig: VirtualRig, seed: int) -> Case:
    """Combine the small cube with three exposures of a grid on the image intensifier."""
    cube = small_cube(rig, seed)
    grid = grid_on_intensifier(rig, seed, 3)
    shifted = [replace(f, number=f.number + 100) for f in grid.frames]
    return Case(cube.frames + shifted, both(cube.phantom, grid.phantom))


def known_orientation(
    rig: VirtualRig,
    seed: int,
    count: int = 40,
    targets: int = 12,
    sd: tuple[tuple[float, float, float], tuple[float, float]] | None = None,
) -> Case:
    """Simulate moving markers with known coordinates, and K, R and t of the fluoroscope."""
    fluoroscope = rig.fluoroscopes[0]
    rng = np.random.default_rng([seed, 10])
    frames = []
    parts = []
    for number in range(1, count + 1):
        # Fill the field of view, with some depth.
        cloud = rng.uniform(-1, 1, (targets, 3)) * (180, 180, 100) @ fluoroscope.rotation
        detection = Detection(beads=(targets, targets), false_matches=0.01 * (targets > 9))
        ids, uv = detect_beads(rng, fluoroscope, cloud, np.arange(targets), detection)
        frames.append(Frame('a', number, ids, uv, fluoroscope.image_size))
        parts.append(cloud)
    xyz = np.concatenate(parts)
    moving = MovingPoints(
        np.repeat(np.arange(1, count + 1), targets),
        np.tile(np.arange(targets), count),
        xyz + rng.normal(0, POINT_SD_MM, xyz.shape),
        np.full(len(xyz), POINT_SD_MM),
    )
    interior = fluoroscope.interior
    position = fluoroscope.position_mm
    rotation = fluoroscope.rotation
    if sd is not None:
        interior_sd, (sd_mm, sd_rad) = sd
        interior = interior + rng.normal(0, interior_sd)
        position = position + rng.normal(0, sd_mm, 3)
        rotation = matrix_from_vector(rng.normal(0, sd_rad, 3)) @ rotation
    known = KnownOrientation(interior, rotation, position)
    if sd is not None:
        known = replace(known, interior_sd=sd[0], exterior_sd=sd[1])
    given, phantom = moving.as_phantom({'a': frames})
    return Case(given['a'], phantom, known={'a': known})


CASES: dict[str, Callable[[VirtualRig, int], Case]] = {
    'grid, tilted by 10 to 40 degrees': tilted_grid,
    'grid, tilted by 10 to 25 degrees': lambda rig, seed: tilted_grid(rig, seed, 15, 25.0),
    'grid, 6 exposures': lambda rig, seed: tilted_grid(rig, seed, 6),
    'grid, 40 % false matches nearby': lambda rig, seed: tilted_grid(
        rig, seed, 15, false_matches=0.4
    ),
    'grid on the intensifier, c given': grid_on_intensifier,
    'grid on the intensifier, one exposure': lambda rig, seed: grid_on_intensifier(rig, seed, 1),
    'known orientation, 40 exposures of 12 markers': known_orientation,
    'known orientation, 100 exposures of 4 markers': lambda rig, seed: known_orientation(
        rig, seed, 100, 4
    ),
    'known orientation with standard deviations': lambda rig, seed: known_orientation(
        rig, seed, 40, 12, ((10.0, 10.0, 10.0), (1.0, 3e-4))
    ),
    'cube of 64 beads': small_cube,
    'cube of 64 beads and grid on the intensifier': cube_and_grid,
}


def points_rmse(
    rig: VirtualRig,
    frames: Sequence[Frame],
    interior: np.ndarray,
    predict: Callable[[np.ndarray], np.ndarray],
) -> float:
    """Return the 3-D RMSE [mm] of the object points of exposures, with a fixed calibration.

    The survey has a low weight, so that the images determine the points.
    """
    weak = replace(rig.phantom, sd_mm=WEAK_SURVEY * rig.phantom.sd_mm)
    sensor = KnownSensor(interior, lambda frame: predict(frame.uv))
    measured = measured_network({'a': frames}, weak, sensors={'a': sensor})
    network = measured.network
    after, _ = adjusted_with_precision(
        network, measured.start, predict(network.uv), start_noise('student_t')
    )
    rows = measured.target_id - rig.phantom.target_id[0]
    error = after.parameters.points_mm - rig.true_mm[rows]
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def run_case(
    make: Callable[[VirtualRig, int], Case], seed: int
) -> tuple[float, float, np.ndarray, float]:
    """Return the errors with estimated and with known distortion, and the time in seconds."""
    rig = virtual_rig(seed)
    fluoroscope = rig.fluoroscopes[0]
    case = make(rig, seed)
    began = time.perf_counter()
    found = calibrate_request(case.request(case.frames)).calibrations['a']
    seconds = time.perf_counter() - began
    undistorted = without_distortion(case.frames, fluoroscope)
    known = calibrate_request(case.request(undistorted, model='none')).calibrations['a']
    test = simulate_exposures(rig, TESTED, TEST_SEED + seed, Detection(false_matches=0.0))
    frames = test.frames['a']
    with threadpool_limits(1):
        ours = points_rmse(rig, frames, found.interior, found.model.predict)
        best = points_rmse(
            rig, without_distortion(frames, fluoroscope), known.interior, np.zeros_like
        )
    return ours, best, found.interior - fluoroscope.interior, seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seeds', type=int, default=5)
    parser.add_argument('--case', default='')
    arguments = parser.parse_args()
    print('| case | points [mm] | distortion known [mm] | ratio | worst | error of c [px] | s |')
    print('| --- | ---: | ---: | ---: | ---: | ---: | ---: |')
    for name, make in CASES.items():
        if arguments.case not in name:
            continue
        results = [run_case(make, seed) for seed in range(arguments.seeds)]
        ours, best = (np.array([r[i] for r in results]) for i in (0, 1))
        rms = [float(np.sqrt(np.mean(a**2))) for a in (ours, best)]
        c = float(np.sqrt(np.mean([r[2][2] ** 2 for r in results])))
        print(
            f'| {name} | {rms[0]:.4f} | {rms[1]:.4f} | {rms[0] / rms[1]:.3f} '
            f'| {np.max(ours / best):.3f} | {c:.1f} | {np.mean([r[3] for r in results]):.1f} |',
            flush=True,
        )


if __name__ == '__main__':
    main()
