"""The kernels for a GPU on Warp's CPU device, where a block's threads are fibers that change at
barriers."""

import pytest

from sags_node.engine import device
from sags_node.engine.gpu import runtime


def use_warp_on_cpu(patch: pytest.MonkeyPatch) -> None:
    """Until `patch` is undone, this machine has a GPU."""
    patch.setattr(device, "find_gpu", lambda: device.Device("cuda", "Warp's CPU device"))
    patch.setattr(device, "gpu", lambda: runtime.device_named("cpu"))
