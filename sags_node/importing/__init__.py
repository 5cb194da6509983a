"""`sags import --check`: what a folder of recordings is, what is missing or odd in it, and how to fix it.

Imports calibration, config, media, rig and sources.
"""
