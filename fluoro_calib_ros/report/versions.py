# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Versions of what a result was computed with."""

from __future__ import annotations

import platform
from importlib import metadata

PACKAGES = ('fluoro_calib_ros', 'numpy', 'scipy')
FROM_SOURCE = 'from source'


def versions() -> dict[str, str]:
    """Return the versions of Python, this package and its numerical libraries, by name."""
    out = {'Python': platform.python_version()}
    for package in PACKAGES:
        try:
            out[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            out[package] = FROM_SOURCE
    return out
