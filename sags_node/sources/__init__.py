"""The sources of frames: recordings, cameras, data sets, network streams.

Imports bags, config, kernels, media, messaging, phantom, rig and ros.
"""
