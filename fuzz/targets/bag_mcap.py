# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""An MCAP bag file: read, inspected and recovered."""

from __future__ import annotations

import shutil
from pathlib import Path

from fluoro_calib_ros.io.bags.reader import image_topics, iterate_messages, read_frames
from fluoro_calib_ros.io.bags.salvage import inspect_bag, recover_bag

from ..harness import Target, both
from ..seeds import bag_content


def _read(path: Path) -> None:
    out = path.parent / 'recovered'

    def recovered() -> None:
        try:
            recover_bag(path, out)
        finally:
            shutil.rmtree(out, ignore_errors=True)

    both(
        lambda: read_frames(path),
        lambda: sum(1 for _ in iterate_messages(path)),
        lambda: inspect_bag(path).faults,
        lambda: image_topics(path),
        recovered,
    )


TARGET = Target('bag_mcap', 'bag.mcap', _read, lambda: [bag_content()])
