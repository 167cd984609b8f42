# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""metadata.yaml of a bag folder, with its QoS profiles and expected message counts."""

from __future__ import annotations

from pathlib import Path

import yaml

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io.access import read_text
from fluoro_calib_ros.io.bags.mcap_file import is_foreign, storage_files
from fluoro_calib_ros.io.bags.metadata import parse_profiles
from fluoro_calib_ros.io.bags.reader import topics_of
from fluoro_calib_ros.io.bags.salvage import Salvage

from ..harness import Target, both
from ..seeds import bag_content, bag_folder, in_folder


def _read(path: Path) -> None:
    storage = path.parent / 'bag_0.mcap'
    if not storage.exists():
        storage.write_bytes(bag_content())

    def profiles() -> None:
        try:
            text = read_text(path)
        except DataError:
            return
        for each in parse_profiles(text):
            parse_profiles([each])

    both(
        lambda: is_foreign(path.parent),
        lambda: storage_files(path.parent),
        lambda: topics_of(path.parent),
        lambda: Salvage(path.parent).expected,
        profiles,
    )


def _seeds() -> list[bytes]:
    content = in_folder(bag_folder, 'metadata.yaml')
    information = yaml.safe_load(content)['rosbag2_bagfile_information']
    profiles = information['topics_with_message_count'][0]['topic_metadata'][
        'offered_qos_profiles'
    ]
    return [content, yaml.safe_dump(profiles).encode(), content.replace(b'mcap', b'sqlite3', 1)]


TARGET = Target('bag_metadata', 'metadata.yaml', _read, _seeds)
