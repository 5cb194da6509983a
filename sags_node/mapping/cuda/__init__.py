"""The mapper's refinement on a GPU."""
