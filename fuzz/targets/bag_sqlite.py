# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""An sqlite3 bag file, as rosbag2 wrote them before Jazzy."""

from __future__ import annotations

import tempfile
from pathlib import Path

from rosbags.rosbag2 import StoragePlugin, Writer

from fluoro_calib_ros.io.bags.metadata import (
    TARGET_OBSERVATIONS,
    message_from_frame,
    to_cdr,
    typestore,
)
from fluoro_calib_ros.io.bags.reader import iterate_messages, read_frames, topics_of

from ..harness import Target, both
from ..seeds import frames


def _read(path: Path) -> None:
    both(
        lambda: topics_of(path),
        lambda: read_frames(path),
        lambda: sum(1 for _ in iterate_messages(path)),
    )


def _seeds() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / 'bag'
        with Writer(bag, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
            for name, of_one in frames().items():
                connection = writer.add_connection(
                    f'/{name}/target_observations', TARGET_OBSERVATIONS, typestore=typestore()
                )
                for frame in of_one:
                    data = to_cdr(message_from_frame(frame), TARGET_OBSERVATIONS)
                    writer.write(connection, frame.stamp_ns, data)
        return [next(bag.glob('*.db3')).read_bytes()]


TARGET = Target('bag_sqlite', 'bag.db3', _read, _seeds)
