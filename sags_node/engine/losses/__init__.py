"""The loss of a drawn picture, and its derivative, for the CPU."""
