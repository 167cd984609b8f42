# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A virtual dual fluoroscope: phantom, rig, distortion, exposures and markers, with truth."""
