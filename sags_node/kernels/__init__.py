"""What every compiled kernel of the package stands on: its compiler's options and its threads.

Imports no other folder.
"""
