# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""ROS 2 nodes: parameters, topics and message conversion for the other subpackages.

Only this subpackage imports rclpy and message packages.
"""
