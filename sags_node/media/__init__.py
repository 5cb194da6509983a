"""Reads and writes image and video files, with the limits that foreign files need.

Imports no other folder.
"""
