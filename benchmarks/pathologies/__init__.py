# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibrations of rigs that differ from the virtual rig of the package.

The generator shares no code with `fluoro_calib_ros.simulation`: `fields` has its own family of
distortions, `phantoms` its own geometries, `scene` its own cameras, poses, noise and false
matches. `cases` declares the pathologies, `oracle` and `measure` compare a calibration with one
for which the distortion is known, `run` is the program and `page` writes
docs/how_good/pathologies.md.
"""
