"""Recordings in MCAP: written, read, played, recovered.

Imports config, media, messaging and rig.
"""
