"""Frames of image points and the phantom: validation, pairing and collecting."""
