"""The drift watch: tell from tracked markers that a calibration no longer holds."""
