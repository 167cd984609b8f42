"""Validation of a calibration with the exposures it was made from."""
