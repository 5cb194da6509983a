"""Bags of MCAP and ROS 1, and the ROS messages in them: read.

Imports config, media, messaging and rig.
"""
