"""Jobs: whole tasks, such as a calibration with its validation and its files, in this process or
in another.
"""
