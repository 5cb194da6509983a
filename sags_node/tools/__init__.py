"""Work on recordings, with the node's pipeline inside."""
