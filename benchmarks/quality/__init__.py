"""How accurate images, depth, masks and poses are, regardless of time."""
