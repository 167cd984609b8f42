"""Bags: MCAP as rosbag2 (Jazzy) writes it, written and read without ROS."""
