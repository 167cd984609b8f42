# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files: phantom, observations, calibration, image points and results, read with care and written
whole.
"""
