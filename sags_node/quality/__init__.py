"""How right images and depth are: the metrics, and the tiles that show it.

Imports no other folder.
"""
