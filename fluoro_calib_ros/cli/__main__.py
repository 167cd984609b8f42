# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""`python -m fluoro_calib_ros.cli`."""

from . import main

main()
