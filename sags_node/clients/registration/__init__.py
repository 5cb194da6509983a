"""Where a model lies on measured tissue, by pairs of points and by its surface, and how sure that is.

Imports no other folder.
"""
