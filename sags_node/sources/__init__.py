"""Where frames come from: recordings, cameras, data sets, network streams.

Imports config, kernels, media, messaging, phantom, recording, rig and ros.
"""
