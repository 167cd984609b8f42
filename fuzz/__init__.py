# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fuzz every reader: one module per target, all checked for the property defined in `harness`.

`make fuzz SECONDS=600` runs them guided by the coverage of atheris; tests use hypothesis instead.
"""
