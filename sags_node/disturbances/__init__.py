"""What goes wrong in an operating room, done to the pictures of any recording for a stretch of time.

Imports phantom.
"""

from sags_node.disturbances.catalogue import DISTURBANCES, Disturbance
from sags_node.disturbances.scene import Scene
from sags_node.disturbances.stream import Taken, disturbed

__all__ = ["DISTURBANCES", "Disturbance", "Scene", "Taken", "disturbed"]
