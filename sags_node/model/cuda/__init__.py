"""Skinning and control nodes on a GPU."""
