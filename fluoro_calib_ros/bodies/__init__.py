# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rigid bodies: shapes, poses straight from image points, motion over a trial, joints."""
