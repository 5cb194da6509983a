"""How a GPU fails, said without torch: none that can be used, or one with too little memory."""

from sags_node.errors import SagsError


class DeviceMemoryError(SagsError):
    """The GPU has not enough memory for what was asked of it; with fewer Gaussians it might."""


class UnusableError(Exception):
    """Why no GPU can be used, and how to fix it."""

    def __init__(self, reason: str, fix: str) -> None:
        super().__init__(reason)
        self.reason, self.fix = reason, fix
