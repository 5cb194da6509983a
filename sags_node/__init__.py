"""SAGS node: an online, deformable, alias-free Gaussian model of tissue from stereo endoscope video."""

__version__ = "0.1.0"
