# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Storage files of a bag: an .mcap file, or those in the folder of a rosbag2 bag."""

from __future__ import annotations

import os
import re

import yaml

from ..errors import DataError
from ..files.access import os_error_reason, read_text
from ..files.yaml_text import parse_yaml

PathLike = str | os.PathLike[str]


def storage_files(source: PathLike) -> list[str]:
    """Return the paths of the .mcap files of a bag, in order.

    A bag folder has those that its metadata.yaml lists; without metadata.yaml all of them count,
    in the order of their numbers. Raises DataError for a source that is not a bag.
    """
    if not os.path.lexists(source):
        raise DataError(f'{source}: there is no such bag')
    if not os.path.isdir(source):
        return [os.fspath(source)]
    metadata = os.path.join(source, 'metadata.yaml')
    if os.path.lexists(metadata):
        return _listed_files(source, metadata)
    return _files_in(source)


def candidate_files(source: PathLike) -> list[str]:
    """Return the paths of the .mcap files of a damaged bag, whatever its metadata.yaml says.

    Raises DataError for a source that is not a bag.
    """
    if not os.path.lexists(source):
        raise DataError(f'{source}: there is no such bag')
    return _files_in(source) if os.path.isdir(source) else [os.fspath(source)]


def _files_in(source: PathLike) -> list[str]:
    """Return the paths of the .mcap files in a folder, in the order of their numbers."""
    try:
        names = [name for name in os.listdir(source) if name.endswith('.mcap') and name[0] != '.']
    except OSError as error:
        raise DataError(
            f'{source}: the folder cannot be read ({os_error_reason(error)})'
        ) from None
    if not names:
        raise DataError(
            f'{source}: this folder is not a bag, it has neither metadata.yaml nor an .mcap file'
        )
    return [os.path.join(source, name) for name in sorted(names, key=_natural_order)]


def _natural_order(name: str) -> list[tuple[int, str]]:
    """Return a sort key by which bag_10 follows bag_9."""
    return [
        (int(part), '') if part.isdigit() else (-1, part) for part in re.split(r'([0-9]+)', name)
    ]


def _listed_files(source: PathLike, path: str) -> list[str]:
    """Return the files that metadata.yaml lists. Raises DataError."""
    try:
        information = parse_yaml(read_text(path))['rosbag2_bagfile_information']
        storage = str(information['storage_identifier'])
        names = list(information['relative_file_paths'])
    except (yaml.YAMLError, KeyError, TypeError, AttributeError):
        raise DataError(f'{path}: this is not the metadata of a bag, or it is damaged') from None
    if storage != 'mcap':
        raise DataError(
            f'{path}: the bag is stored as {storage}, only mcap and sqlite3 are supported; '
            f'convert it with ros2 bag convert'
        )
    if not names or not all(isinstance(name, str) for name in names):
        raise DataError(f'{path}: the bag has no files')
    paths = [os.path.join(source, os.path.basename(name)) for name in names]
    for each in paths:
        if not os.path.exists(each):
            raise DataError(
                f'{path}: it lists {os.path.basename(each)}, but the folder has no such file'
            )
    return paths
