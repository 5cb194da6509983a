"""The rasteriser and the mapper's loss, forward and backward, on CPU and GPU.

Imports config and kernels.
"""
