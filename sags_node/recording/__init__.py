"""Recordings in MCAP: written, read, played, recovered.

Imports calibration and messaging.
"""
