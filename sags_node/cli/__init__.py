"""The `sags` command: one file for each group of commands. Nothing imports it.

Imports archive, benchmark, bridge, calibrate, calibration, disturbances, engine, evaluation, export, fitting,
kernels, mapping, messaging, model, overlay, phantom, recording, ros, terminal and viewer.
"""
