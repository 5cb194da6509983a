"""Recordings in MCAP: written, read, played, recovered.

Imports bags, config, media, messaging and rig.
"""
