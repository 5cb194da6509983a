"""`sags view`: a running node in a web browser on this machine (extra `viewer`: viser).

Imports messaging, model and quality.
"""
