"""Registration of a model to measured tissue, by pairs of points and by its surface, and its expected error.

Imports no other folder.
"""
