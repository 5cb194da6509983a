"""The way of a frame from the camera to the model, the session that a launch opens, and the warm-up.

Imports config, detail, engine, instruments, kernels, mapping, messaging, model, phantom, rig, sources and
vision.
"""
