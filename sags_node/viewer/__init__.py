"""`sags view`: a running node in a web browser on this machine (extra `viewer`: viser).

Imports evaluation, export, messaging and model.
"""
