"""The wire: topics, messages, sockets, keys, publisher and subscribers.

Imports no other folder.
"""
