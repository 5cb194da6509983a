"""A ROS 2 graph without ROS (extra `ros2`): joined as a process of its own, read and written.

Imports config and messaging.
"""
