"""The Gaussian model: its rows, how it deforms, its filters, light and files; the field of SAGS.

Imports engine and kernels.
"""
