"""What bridges are told, as far as it is the same for several of them."""

from __future__ import annotations

import socket
from dataclasses import dataclass

from sags_node.errors import SagsError
from sags_node.messaging.address import NodeAddress

MAX_AGE = 0.4  # s since capture: with `relay.LOOK` and the way to a peer, what stops is gone within 0.5 s


@dataclass(frozen=True, slots=True)
class BridgeOptions:
    """How a bridge runs; the defaults are those of the command."""

    node: NodeAddress
    overlay: NodeAddress
    max_age: float = MAX_AGE


@dataclass(frozen=True, slots=True)
class ServerOptions(BridgeOptions):
    """How a bridge runs that peers connect to."""

    host: str = "127.0.0.1"
    port: int = 0  # 0: any free one

    def listen(self, backlog: int) -> socket.socket:
        """Bind the address.

        Raises:
            SagsError: it cannot be bound.
        """
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        try:
            return socket.create_server((self.host, self.port), family=family, backlog=backlog)
        except OSError as error:
            raise SagsError(self.not_bound(error.strerror)) from None

    def not_bound(self, why: object) -> str:
        """The error of an address that cannot be bound."""
        return f"cannot listen on {self.host} port {self.port}: {why}; choose another --port (0: any)"
