"""`sags bridge`: what a node sends, in the words of other systems (extra `bridges`).

`relay` is the loop that all bridges share; `openigtlink` and `foxglove` are what it speaks to.

Imports messaging and overlay.
"""
