"""Conversion of ROS messages, one module for each message or group of services.

No other module of the nodes knows the fields of these messages. Arrays are copied as a whole,
never element by element.
"""
