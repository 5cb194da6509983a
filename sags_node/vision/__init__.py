"""What is seen in a picture: rectification, masks, depth, flow, and what is wrong with it.

Imports config, kernels and rig.
"""
