# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""options.json of a result folder, and result.json where another command reads it."""

from __future__ import annotations

import json
from pathlib import Path

from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.io.calibration_request import read_options
from fluoro_calib_ros.io.documents import json_text, read_json

from ..harness import Target, both


def _seeds() -> list[bytes]:
    documents = [
        {
            'format_version': 1,
            'options': options.to_document(),
            'joint': joint,
            'principal_distance': distance,
        }
        for options, joint, distance in (
            (CalibrationOptions(), False, None),
            (
                CalibrationOptions(
                    model='knn', k=9, relative_orientation='soft', interior_sd=(1.0, 2.0, 3.0)
                ),
                True,
                4000.0,
            ),
        )
    ]
    return [json.dumps(document).encode() for document in documents]


def _read(path: Path) -> None:
    both(lambda: read_options(path), lambda: json_text(read_json(path)))


TARGET = Target('options_json', 'options.json', _read, _seeds)
