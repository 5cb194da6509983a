"""`sags bridge`: what a node sends, in the words of other systems (extra `bridges`).

`relay` is the loop that all bridges share; `openigtlink`, `foxglove` and `ros2` are what it speaks to.

Imports messaging, overlay, recording and ros.
"""
