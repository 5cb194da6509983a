"""How right pictures, depth, masks and poses are, whatever the time."""
