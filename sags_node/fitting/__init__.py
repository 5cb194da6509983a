"""Offline fit of the deformable model to a whole clip.

Imports engine, evaluation, mapping and model.
"""
