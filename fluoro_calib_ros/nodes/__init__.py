"""ROS 2 nodes: parameters, topics and conversion around the other rooms. The only room that knows
rclpy.
"""
