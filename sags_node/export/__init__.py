"""`sags export`: the model at one moment as files that other programs open.

Imports engine, fitting, kernels, messaging, model and terminal.
"""
