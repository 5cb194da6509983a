"""The `sags` command: one file for each group of commands. Nothing imports it.

Imports bridge, calibrate, calibration, engine, evaluation, export, fitting, importing, kernels,
mapping, messaging, model, overlay, phantom, recording, ros, terminal and viewer.
"""
