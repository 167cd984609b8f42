# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Whole images without distortion: where each pixel comes from, found once, and encoded images."""
