# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Frames of image points and the phantom: validation, pairing and collection of exposures."""
