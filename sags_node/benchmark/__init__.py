"""`sags bench`: run time and error, measured.

Imports calibration, disturbances, engine, evaluation, fitting, kernels, mapping, messaging, model, phantom,
recording, ros, sources and vision.
"""
