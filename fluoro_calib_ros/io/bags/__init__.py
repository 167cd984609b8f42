# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bags: MCAP in the layout of rosbag2, read and written without ROS."""
