"""What is seen in an image: rectification, masks, depth, flow, and what is wrong with it.

Imports config, kernels and rig.
"""
