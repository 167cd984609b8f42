# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Points in space from two or more corrected views: matching, epipolar check, intersection."""
