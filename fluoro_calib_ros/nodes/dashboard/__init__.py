# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Dashboard of a session: its state, its views, and the ROS client behind them."""
