# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The drift watch: tell from tracked markers that a calibration no longer holds."""
