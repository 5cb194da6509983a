"""How commands talk to people and programs: tables, progress, warnings, JSON.

Imports no other folder.
"""
