"""Images carry the detail, the model carries geometry and motion.

A Gaussian model small enough for the camera's rate is softer than the image that it was made from. So what
is shown is that image, looked up where the model says that each pixel's tissue was, and blended with the
drawn model by how well such images did lately.

To be read in this order: `seen` (a frame that lends its image), `carry` (the kernel), `motion` (where the
tissue was), `share` (how far to trust it), `memory` (what is hidden now), `show` (all of it together).

Imports engine, kernels, mapping and model.
"""
