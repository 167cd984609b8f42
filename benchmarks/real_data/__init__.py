# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Out-of-sample tests of calibrations from public data of real cameras, with OpenCV and mrcal.

python -m benchmarks.real_data --list                     sources and licences
python -m benchmarks.real_data --download                 fetch them into real_data/
python -m benchmarks.real_data --data FOLDER [--mrcal PYTHON]   the page, from data there

The page is docs/how_good/real_data.md.
"""
