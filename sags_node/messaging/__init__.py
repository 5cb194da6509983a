"""The wire: topics, messages, sockets, keys, publisher and subscribers.

Imports config and media.
"""
