"""Figures and tables of a calibration, for people."""
