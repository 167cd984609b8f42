# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Jobs: complete tasks, such as a calibration with its validation and its files."""
