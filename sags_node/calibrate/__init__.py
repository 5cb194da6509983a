"""`sags calib`: pictures of a board to a calibration, and a calibration checked.

Imports calibration, phantom, sources, terminal and vision.
"""
