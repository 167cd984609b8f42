"""Frames of image points and the phantom: validation, pairing and collection of exposures."""
