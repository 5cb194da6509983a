"""`sags bench`: run time and error, measured.

Imports calibration, disturbances, engine, evaluation, fitting, kernels, mapping, messaging, model, phantom,
sources and vision.
"""
