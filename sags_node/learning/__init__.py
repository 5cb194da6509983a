"""A small stereo network of one's own, trained on pairs whose disparity is known: `sags train depth`.

Imports phantom, sources and vision.
"""
