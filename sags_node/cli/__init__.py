"""The `sags` command: one file for each group of commands. Nothing imports it.

Imports bridge, calibration, config, engine, evaluation, export, fitting, importing, kernels, latency,
mapping, messaging, model, node, overlay, phantom, pipeline, recording, rig, ros, sources, terminal and
viewer.
"""
