# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Real faults injected into running nodes: docs/reliability.md.

python -m benchmarks.faults [--only KIND,...] [--count N] [--seed N]
"""
