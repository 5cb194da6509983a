"""The Gaussian model: its rows, how it deforms, its filters, light and files.

Imports engine and kernels.
"""
