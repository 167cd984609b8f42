"""Self-calibration of X-ray fluoroscopes and live correction of their image coordinates in ROS 2."""
