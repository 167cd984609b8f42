# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibrations from public data of real cameras, out of sample, beside OpenCV and mrcal.

python -m benchmarks.real_data --list                     sources and licences
python -m benchmarks.real_data --download                 fetch them into real_data/
python -m benchmarks.real_data --data FOLDER [--mrcal PYTHON]   the page, from data there

The page is docs/how_good/real_data.md.
"""
