"""Beads of a phantom found, measured and matched in radiographs."""
