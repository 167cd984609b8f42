"""Measurements: speed (python -m benchmarks) and accuracy against the truth (python -m
benchmarks.validation).
"""
