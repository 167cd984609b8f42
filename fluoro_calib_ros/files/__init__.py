"""Files: phantom, observations, calibration, image points and results, read with care and written
whole.
"""
