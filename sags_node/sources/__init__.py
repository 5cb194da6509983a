"""Where frames come from: recordings, cameras, data sets, network streams.

Imports calibration, kernels, messaging, phantom and recording.
"""
