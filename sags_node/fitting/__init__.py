"""Offline fit of the deformable model to a whole clip."""
