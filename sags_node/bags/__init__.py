"""Reads bags (rosbag2, MCAP, ROS 1), and the ROS messages in them.

Imports config, media, messaging and rig.
"""
