"""Validation: the verdict on a calibration."""
