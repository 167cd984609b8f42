# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Base of all nodes: parameters, lifecycle, streams, diagnostics, logging and the main loop."""
