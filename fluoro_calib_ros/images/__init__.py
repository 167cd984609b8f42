"""Whole images without distortion: where each pixel comes from, found once, and encoded images."""
