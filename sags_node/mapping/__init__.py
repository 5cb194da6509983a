"""The online model while the video runs: motion, new Gaussians, refinement, pose, anchors, the ladder.

Imports engine, kernels, model and vision.
"""
