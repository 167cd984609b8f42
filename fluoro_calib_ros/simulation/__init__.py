"""A virtual dual fluoroscope: phantom, rig, distortion, exposures and markers, with truth."""
