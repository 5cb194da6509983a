"""Joins a ROS 2 graph without ROS (extra `ros2`), as a process of its own; reads and writes topics.

Imports config and messaging.
"""
