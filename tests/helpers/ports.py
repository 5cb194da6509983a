"""Ports that a test may come back to."""

import random
import socket

FIRST, LAST = 20_000, 30_000  # below those that systems give away by themselves


def is_free(port: int) -> bool:
    """Nobody listens on it."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
        return True


def free_port() -> int:
    """A TCP port on which nobody listens, and which nobody gets by chance."""
    while True:
        port = random.SystemRandom().randrange(FIRST, LAST)
        if is_free(port):
            return port
