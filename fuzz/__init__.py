# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fuzzing of every reader: one module a target, all with the property of `harness`.

`make fuzz SECONDS=600` runs them with the coverage of atheris; the tests run them with hypothesis.
"""
