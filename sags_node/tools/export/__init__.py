"""`sags export`: the model at one moment, or all frames of a recording, as files that other programs open.

Imports engine, evaluation, fitting, kernels, media, messaging, model and pipeline.
"""
