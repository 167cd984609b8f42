"""Faults that are made for real: docs/reliability.md.

python -m benchmarks.faults [--only KIND,...] [--count N] [--seed N]
"""
