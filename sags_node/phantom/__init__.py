"""A synthetic stereo endoscope session: deforming tissue, instruments, and the exact truth of both.

Imports config and rig.
"""

from sags_node.phantom.scene import PhantomScene
from sags_node.phantom.session import cached_session, write_session

__all__ = ["PhantomScene", "cached_session", "write_session"]
