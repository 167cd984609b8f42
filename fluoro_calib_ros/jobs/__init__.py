"""Jobs: complete tasks, such as a calibration with its validation and its files."""
