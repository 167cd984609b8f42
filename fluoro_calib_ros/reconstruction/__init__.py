"""Points in space from two or more corrected views: matching, epipolar check, intersection."""
