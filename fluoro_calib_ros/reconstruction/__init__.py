"""Points in space from two or more corrected views: orientation of the rig, epipolar check,
intersection of rays.
"""
