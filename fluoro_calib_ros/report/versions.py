# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Versions that a report and the command line print; they load no library."""

from __future__ import annotations

import platform
from importlib import metadata

PACKAGES = ('fluoro_calib_ros', 'numpy', 'scipy')
FROM_SOURCE = 'from source'


def versions() -> dict[str, str]:
    """Return the versions of Python, this package and its numerical libraries, by name."""
    installed = {'Python': platform.python_version()}
    for package in PACKAGES:
        try:
            installed[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            installed[package] = FROM_SOURCE
    return installed
