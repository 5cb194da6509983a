"""The online model while the video runs: motion, new Gaussians, refinement, pose, anchors, the ladder.

Imports config, engine, field, kernels, model and vision.
"""
