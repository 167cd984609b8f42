"""ROS 2 nodes: parameters, topics and message conversion around the other rooms.

Only this room imports rclpy and message packages.
"""
