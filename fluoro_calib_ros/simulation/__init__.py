"""A virtual dual fluoroscope: phantom, rig, distortion, exposures and moving markers, with their
truth.
"""
