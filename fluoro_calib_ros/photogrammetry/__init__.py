"""Photogrammetry: collinearity, resection, robust bundle adjustment and precision. Arrays in,
arrays out.
"""
