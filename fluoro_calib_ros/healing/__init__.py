# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What has changed in a rig that sees known bodies, with what probability, and the healed rig."""
