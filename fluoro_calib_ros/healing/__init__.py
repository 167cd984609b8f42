# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Diagnosis of changes of a rig that sees known bodies, with probabilities, and the healed rig."""
