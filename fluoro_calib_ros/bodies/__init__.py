# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rigid bodies: shapes, poses directly from image points, motion over a trial, and joints."""
