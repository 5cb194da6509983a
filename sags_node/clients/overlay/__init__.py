"""`sags overlay`: meshes held by the tissue, drawn over the live image; `sags register` places them.

Imports config, kernels, media, messaging and registration.
"""
