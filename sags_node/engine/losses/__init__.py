"""The loss of a drawn image, and its derivative, for the CPU."""
