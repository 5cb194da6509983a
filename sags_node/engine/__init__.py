"""The rasteriser, the space-time field and the losses, forward and backward, on CPU and GPU.

Imports config and kernels.
"""
