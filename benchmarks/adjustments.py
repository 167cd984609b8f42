# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Adjust many image points with this package and COLMAP: same problem, initial values and cost."""

from typing import Any

import numpy as np

from fluoro_calib_ros.photogrammetry.adjustment import adjust
from fluoro_calib_ros.photogrammetry.collinearity import project
from fluoro_calib_ros.photogrammetry.network import Network
from fluoro_calib_ros.photogrammetry.noise import Noise
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.photogrammetry.unknowns import Parameters
from fluoro_calib_ros.simulation.rig import phantom_poses, virtual_rig

from .peers import ColmapAdjustment, with_datum
from .timing import timed

NOISE = Noise('student_t', 0.25, 5.0)
SIZES = (15, 150)  # exposures
HELD_EVERY = 10  # every tenth object point is fixed: a datum that COLMAP can express
# Ceres stops at this relative decrease of its cost, which then equals ours to ten digits.
STOP = {
    'function_tolerance': 1e-11,
    'gradient_tolerance': 0.0,
    'parameter_tolerance': 0.0,
    'max_num_iterations': 200,
}


def large_network(exposures: int, seed: int = 0) -> tuple[Network, Parameters]:
    """Return a network with all beads in all exposures, and disturbed initial values.

    The beads are those of the virtual rig; the noise is Student-t.
    """
    rng = np.random.default_rng([seed, exposures])
    rig = virtual_rig(1)
    fluoroscope = rig.fluoroscopes[0]
    beads = len(rig.true_mm)
    orientations = [fluoroscope.exterior(pose) for pose in phantom_poses(rng, exposures)]
    rotation, position = (np.array(part) for part in zip(*orientations))
    exposure = np.repeat(np.arange(exposures), beads)
    point = np.tile(np.arange(beads), exposures)
    uv = project(rotation[exposure], position[exposure], rig.true_mm[point], fluoroscope.interior)
    tails = np.sqrt(rng.chisquare(NOISE.nu, len(uv)) / NOISE.nu)
    uv += rng.normal(0, NOISE.scale, uv.shape) / tails[:, None]
    network = Network(
        uv,
        np.ones(len(uv)),
        exposure,
        point,
        np.zeros(exposures, dtype=int),
        rig.phantom.xyz_mm,
        rig.phantom.sd_mm,
        np.array([True]),
    )
    # As large as the errors of resections from distorted images.
    turn = matrix_from_vector(rng.normal(0, 2e-3, position.shape))
    start = Parameters(
        fluoroscope.interior[None] + [[5.0, -5.0, 40.0]],
        turn @ rotation,
        position + rng.normal(0, 3.0, position.shape),
        rig.phantom.xyz_mm.copy(),
    )
    return network, start


def compare_with_colmap(exposures: int, repeats: int = 3) -> list[str]:
    """Return a table row with time and cost of an adjustment by this package and by COLMAP."""
    network, start = large_network(exposures)
    held = np.arange(len(network.survey_mm)) % HELD_EVERY == 0
    network = with_datum(network, held)
    ours, seconds = timed(lambda: adjust(network, start, 0.0, NOISE), repeats)

    def colmap() -> tuple[ColmapAdjustment, Any]:
        peer = ColmapAdjustment(network, start, NOISE, held, STOP)
        return peer, peer.solve()

    (peer, summary), with_set_up = timed(colmap, 1 if exposures > 50 else repeats)
    cost = peer.cost(summary)
    return [
        f'{exposures} x {len(held)}',
        f'{len(network.uv)}',
        f'{seconds:.2f} s',
        str(ours.steps),
        f'{ours.cost:.6f}',
        f'{summary.total_time_in_seconds:.2f} s',
        f'{with_set_up:.2f} s',
        str(summary.num_successful_steps + summary.num_unsuccessful_steps),
        f'{cost:.6f}',
        f'{summary.total_time_in_seconds / seconds:.1f}',
    ]


HEADER = [
    'exposures x targets',
    'image points',
    'this package',
    'steps',
    'cost',
    'COLMAP, solver only',
    'COLMAP with set-up',
    'steps',
    'cost',
    'speed-up (solver only)',
]
