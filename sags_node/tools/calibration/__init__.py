"""`sags calib`: images of a board to a rig and to the camera on the robot, and a calibration checked.

Imports config, phantom, rig, sources, terminal and vision.
"""
