# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Measurements: speed (python -m benchmarks) and accuracy against the truth (python -m
benchmarks.validation).
"""
