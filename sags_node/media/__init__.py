"""Reads and writes picture and video files, with the limits that foreign files need.

Imports no other folder.
"""
