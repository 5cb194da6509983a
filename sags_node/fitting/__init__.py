"""Offline fit of the deformable model to a whole clip.

Imports config, engine, evaluation, mapping, model and pipeline.
"""
