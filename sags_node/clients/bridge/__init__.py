"""`sags bridge`: what a node sends, by the protocols of other systems (extra `bridges`).

`relay` is the loop that bridges share; `openigtlink`, `foxglove`, `ros2`, `web` and `gst` are what it speaks
to.

Imports bags, config, media, messaging, overlay, ros and sources.
"""
