# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The terminal dashboard of a session: its state, its view, and the ROS client behind it."""
