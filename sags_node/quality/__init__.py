"""The quality of images and depth: metrics, and tiles that show it.

Imports no other folder.
"""
