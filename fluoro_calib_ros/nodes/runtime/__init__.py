# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What all nodes share: parameters, lifecycle, streams, diagnostics, logging and the main loop."""
