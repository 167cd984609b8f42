# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Message types that are installed: their classes and their definitions."""

from __future__ import annotations

import os
from importlib import import_module
from typing import Any

from ament_index_python.packages import (
    PackageNotFoundError,
    get_package_prefix,
    get_package_share_directory,
)
from rclpy.type_support import check_for_type_support

from ...bags.definitions import SEPARATOR, Definition, fields_of, known_definition, nested_types
from ...errors import DataError
from ...files.access import read_text


def installed_type(name: str) -> type[Any] | None:
    """Return the class of a message type, None where it is not installed.

    Only packages in the ament index are imported: a bag or a peer must not name any module.
    """
    package, _, kind = name.partition('/msg/')
    try:
        get_package_prefix(package)
        message_type: type[Any] = getattr(import_module(f'{package}.msg'), kind)
        check_for_type_support(message_type)
    except (PackageNotFoundError, ValueError, ImportError, AttributeError):
        return None
    return message_type


def definition_of(name: str, type_hash: str) -> Definition:
    """Return the definition of a message type as a bag contains it.

    It is that of this package if it has the hash that publishers offer, '' for an unknown one;
    else the installed .msg files. The text is empty where there are none.
    """
    try:
        known = known_definition(name)
        if type_hash in ('', known.type_hash):
            return known
    except DataError:
        pass
    try:
        return Definition(_installed_text(name, set()), 'ros2msg', type_hash)
    except (DataError, PackageNotFoundError, ValueError):
        return Definition('', 'ros2msg', type_hash)


def _installed_text(name: str, seen: set[str]) -> str:
    """Return the .msg file of a type and those of the types it depends on. Raises DataError."""
    package, _, kind = name.partition('/msg/')
    text = read_text(os.path.join(get_package_share_directory(package), 'msg', f'{kind}.msg'))
    for nested in sorted(nested_types(fields_of(name, text, 'ros2msg')[name])):
        if nested not in seen:
            seen.add(nested)
            heading = f'\n{SEPARATOR}\nMSG: {nested.replace("/msg/", "/")}\n'
            text += heading + _installed_text(nested, seen)
    return text
