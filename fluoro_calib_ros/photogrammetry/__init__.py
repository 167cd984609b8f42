# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Photogrammetry: collinearity, resection, robust bundle adjustment, precision and diagnosis.

The functions take and return numpy arrays and frozen dataclasses. A bundle adjustment uses these
modules in order: `network` (data), `unknowns` (layout and values), `normal_equations`,
`elimination` (solution), `adjustment` (Levenberg-Marquardt), `outliers` (estimation of the noise),
`precision`, then `diagnosis` and `outliers`.
"""
