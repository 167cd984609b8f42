# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The calibration file; the fuzzer sees its arrays without the archive and its checksums."""

from __future__ import annotations

from functools import partial

from fluoro_calib_ros.io.calibration import load_calibration, save_calibration

from ..harness import Target
from ..seeds import archive_of, calibration, flattened, in_folder


def _seeds() -> list[bytes]:
    found = []
    for model in ('none', 'knn', 'parametric'):
        found.append(
            flattened(in_folder(partial(save_calibration, calibration=calibration(model))))
        )
    return found


TARGET = Target('calibration_npz', 'a.calibration.npz', load_calibration, _seeds, archive_of)
