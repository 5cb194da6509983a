"""Slow readable twins in torch, which tests compare the kernels to."""
