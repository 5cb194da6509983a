"""What goes wrong in an operating room, done to the pictures of any recording for a stretch of time.

Imports phantom.
"""

from benchmarks.disturbances.catalogue import DISTURBANCES, Disturbance
from benchmarks.disturbances.scene import Scene
from benchmarks.disturbances.stream import Taken, disturbed

__all__ = ["DISTURBANCES", "Disturbance", "Scene", "Taken", "disturbed"]
