"""The `sags` command: one file for each group of commands. Nothing imports it.

Imports archive, benchmark, bridge, calibrate, calibration, disturbances, engine, evaluation, export, fitting,
importing, kernels, learning, mapping, messaging, model, overlay, phantom, protocols, recording, ros, terminal
and viewer.
"""
