"""Output of commands for people and programs: tables, progress, warnings, JSON.

Imports no other folder.
"""
