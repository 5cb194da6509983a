"""HexPlane field and self-adaptive decoder as kernels for the CPU."""
