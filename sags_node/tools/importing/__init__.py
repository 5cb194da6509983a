"""`sags import --check`, `sags new`: what a folder of recordings is, what is odd in it, and how to play it.

Imports calibration, config, media, pipeline, rig, sources and vision.
"""
