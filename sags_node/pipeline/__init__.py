"""One frame from the camera to the model, what a launch opens for it, and compiling ahead.

Imports config, detail, engine, instruments, kernels, mapping, messaging, model, phantom, rig, sources and
vision.
"""
