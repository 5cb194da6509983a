"""The `sags` command: one file for each group of commands. Nothing imports it.

Imports archive, bridge, calibrate, calibration, engine, evaluation, export, fitting, importing, kernels,
learning, mapping, messaging, model, overlay, phantom, protocols, recording, ros, terminal and viewer.
"""
