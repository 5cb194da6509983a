"""Offline fit of the deformable model to a whole clip.

Imports config, detail, engine, evaluation, field, kernels, mapping, model, pipeline, quality and vision.
"""
