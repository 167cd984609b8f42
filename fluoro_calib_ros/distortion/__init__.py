# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Correction models: what they are fitted to, how they predict, and how their size is chosen."""
