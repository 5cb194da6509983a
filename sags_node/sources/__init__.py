"""Where frames come from: recordings, cameras, data sets, network streams.

Imports calibration, kernels, messaging, phantom, recording and ros.
"""
