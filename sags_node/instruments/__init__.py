"""Instruments as objects: where their tips are, how they point, how far the tissue is.

Imports kernels.
"""
