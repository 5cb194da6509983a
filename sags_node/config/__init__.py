"""How a launch is described: its typed keys, the file that sets them, and how YAML is read.

Imports no other folder.
"""
