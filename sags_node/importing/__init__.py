"""`sags import --check`: what a folder of recordings is, what is missing or odd in it, and how to mend it.

Imports calibrate, calibration and sources.
"""
