"""What goes wrong in an operating room, applied to the images of any recording for some time.

Imports phantom.
"""

from benchmarks.disturbances.catalogue import DISTURBANCES, Disturbance, Taken, disturbed
from benchmarks.disturbances.scene import Scene

__all__ = ["DISTURBANCES", "Disturbance", "Scene", "Taken", "disturbed"]
