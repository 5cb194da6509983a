"""How fast and how good the node is, measured; see README.md here. Not part of the installed package."""
