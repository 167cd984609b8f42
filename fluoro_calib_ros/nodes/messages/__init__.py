# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Conversion of ROS messages, one module for each message or group of services.

No other module in nodes accesses the fields of these messages. Arrays are copied as a whole, never
element by element.
"""
