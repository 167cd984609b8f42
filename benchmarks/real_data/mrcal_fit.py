# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fit lens models with mrcal: a script that needs only numpy and mrcal; `peers` runs it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import mrcal
import numpy as np

METRE = 1e-3  # mrcal's unit of length is the metre
RANGE_M = (1e-4, 1e4)


def fit(task: dict[str, Any], model: str, start: np.ndarray) -> np.ndarray:
    """Return the intrinsics of a lens model, with the targets fixed to their survey."""
    intrinsics = start[None].copy()
    exposures = len(task['poses'])
    poses = task['poses'].copy()
    poses[:, 3:] *= METRE
    rows = np.column_stack(
        [task['row'], np.zeros(len(task['row']), dtype=int), task['exposure']]
    ).astype(np.int32)
    observations = np.column_stack([task['uv'], np.ones(len(rows))])
    for free in ((True, False), (True, True)):
        mrcal.optimize(
            intrinsics=intrinsics,
            extrinsics_rt_fromref=poses,
            frames_rt_toref=None,
            points=task['xyz'] * METRE,
            Npoints_fixed=len(task['xyz']),
            observations_board=None,
            indices_frame_camintrinsics_camextrinsics=None,
            observations_point=observations,
            indices_point_camintrinsics_camextrinsics=rows,
            lensmodel=model,
            imagersizes=task['size'][None].astype(np.int32),
            do_optimize_intrinsics_core=free[0] and 'SPLINED' not in model,
            do_optimize_intrinsics_distortions=free[1],
            do_optimize_extrinsics=True,
            do_optimize_frames=False,
            do_optimize_calobject_warp=False,
            calibration_object_spacing=1.0,
            point_min_range=RANGE_M[0],
            point_max_range=RANGE_M[1],
            do_apply_outlier_rejection=free[1],
            do_apply_regularization=True,
            verbose=False,
        )
    assert len(poses) == exposures
    return intrinsics[0]


def main() -> None:
    """Read the task, and write the directions x/z, y/z of its pixels for each model."""
    path = Path(sys.argv[1])
    with np.load(path) as file:
        task = dict(file)
    matrix = task['matrix']
    core = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    # OpenCV's poses fit its own distortion model, so refinement of all models starts with it.
    rays = {}
    for name, model in zip(task['names'].tolist(), task['models'].tolist()):
        size = mrcal.lensmodel_num_params(model)
        start = np.zeros(size)
        start[:4] = core
        if 'SPLINED' not in model:
            start[4:] = task['distortion'][: size - 4]
        found = fit(task, model, start)
        v = mrcal.unproject(np.ascontiguousarray(task['pixels']), model, found)
        rays[name] = v[:, :2] / v[:, 2:]
    np.savez(path.with_name('result.npz'), **rays)


if __name__ == '__main__':
    main()
