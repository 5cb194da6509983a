"""Files of pictures and videos, read and written with the limits that a stranger's file needs.

Imports no other folder.
"""
