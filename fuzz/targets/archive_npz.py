# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The calibration file itself: a ZIP archive, also with compressed members."""

from __future__ import annotations

import io
import zipfile

from fluoro_calib_ros.io.calibration import load_calibration, save_calibration

from ..harness import Target
from ..seeds import calibration, in_folder


def _seeds() -> list[bytes]:
    content = in_folder(lambda folder: save_calibration(folder, calibration()))
    seeds = [content]
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for kind in (zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
            buffer = io.BytesIO()
            with zipfile.ZipFile(buffer, 'w', kind) as packed:
                for name in archive.namelist():
                    packed.writestr(name, archive.read(name))
            seeds.append(buffer.getvalue())
    return seeds


TARGET = Target('archive_npz', 'a.calibration.npz', load_calibration, _seeds)
