# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Formats of other programs: one module a format, all of them listed in `registry`.

A module reads a file into a `content.Content` and writes one from it. Inside, the conventions are
those of docs/architecture.md: pixel centres at integers from (0, 0), v downwards, millimetres,
rotation from the world to the sensor. What a format does differently is converted in its module
and nowhere else, and docs/formats.md says so.
"""
