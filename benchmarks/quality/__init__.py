"""How accurate pictures, depth, masks and poses are, regardless of time."""
