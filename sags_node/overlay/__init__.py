"""`sags overlay`: meshes held by the tissue, drawn over the live picture, for both eyes.

Imports kernels and messaging.
"""
