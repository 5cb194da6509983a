"""`sags bridge`: what a node sends, in the words of other systems (extra `bridges`).

`relay` is the loop that all bridges share; `openigtlink`, `foxglove`, `web` and `gst` are what it speaks to.

Imports messaging, overlay and sources.
"""
