"""`sags overlay`: meshes held by the tissue, drawn over the live picture, for both eyes.

Imports config, kernels, media and messaging.
"""
