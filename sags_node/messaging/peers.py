"""Who is connected to a bound socket, from ZeroMQ's socket monitor: counted and capped."""

from __future__ import annotations

import logging
import os
import socket as sockets
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import suppress

import zmq
from zmq.utils.monitor import recv_monitor_message

from sags_node.messaging.security import RateLimitedLog
from sags_node.messaging.sockets import HANDSHAKES
from sags_node.workers import go_on

MAX_PEERS = 64  # of one socket; ZeroMQ has no such limit of its own
CHECK_MS = 20  # how soon a key that was taken off the list is seen

log = logging.getLogger(__name__)


class Peers:
    """Follows the connections of one bound socket, from a thread of its own.

    Args:
        socket: not yet bound.
        name: of the socket, for the log.
        revocations: when it grows all tcp peers are cut off, as nothing tells which key a connection came
            with. Those who may come in are back at once.
    """

    def __init__(
        self, socket: zmq.Socket[bytes], name: str, revocations: Callable[[], int] = lambda: 0
    ) -> None:
        self._socket, self._name = socket, name
        self._monitor = socket.get_monitor_socket(zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED | HANDSHAKES)
        self._revocations, self._revoked = revocations, revocations()
        # By libzmq's descriptor a duplicate of it, so that what is cut off is not the next one of its number.
        self._open: dict[int, sockets.socket] = {}
        self._count: Counter[str] = Counter()
        self._seldom = RateLimitedLog()
        self._stopping = threading.Event()
        self._thread = threading.Thread(
            target=go_on, args=(self._follow, self._stopping, name), name=f"sags-{name}-peers", daemon=True
        )
        self._thread.start()

    def counts(self) -> dict[str, int]:
        """Connections that are open, and that were refused since the start, some of those by reason.

        `refused` also holds a connection that is in the middle of its handshake.
        """
        return {
            "open": len(self._open),
            "refused": self._count["accepted"] - self._count["admitted"],
            "unlisted_key": self._count["unlisted_key"],
            "too_many": self._count["too_many"],
        }

    def close(self) -> None:
        """End the thread; before the socket is closed, on its thread."""
        self._socket.disable_monitor()  # first: libzmq waits for a reader when many events have gathered
        self._stopping.set()
        self._thread.join()
        for connection in self._open.values():
            connection.close()

    def _follow(self) -> None:
        if self._monitor.poll(CHECK_MS):
            said = recv_monitor_message(self._monitor)
            self._note(said["event"], int(said["value"]))
        before, self._revoked = self._revoked, self._revocations()
        if self._revoked != before:
            for connection in self._open.values():
                if connection.family != sockets.AF_UNIX:  # which need no key
                    _cut_off(connection)

    def _note(self, event: int, descriptor: int) -> None:
        if event == zmq.EVENT_ACCEPTED:
            self._count["accepted"] += 1
            try:
                connection = sockets.socket(fileno=os.dup(descriptor))
            except OSError:
                return  # it has gone already
            self._open[descriptor] = connection
            if len(self._open) > MAX_PEERS:
                self._count["too_many"] += 1
                _cut_off(connection)
                self._log()
        elif event == zmq.EVENT_DISCONNECTED:
            if (ended := self._open.pop(descriptor, None)) is not None:
                ended.close()
        elif event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
            self._count["admitted"] += 1
        else:
            self._count["unlisted_key"] += event == zmq.EVENT_HANDSHAKE_FAILED_AUTH
            self._log()

    def _log(self) -> None:
        if self._seldom.due():
            log.warning("%s socket: connections refused since the start: %s", self._name, self.counts())


def _cut_off(connection: sockets.socket) -> None:
    """End a connection under libzmq, which then closes it."""
    with suppress(OSError):  # it has gone by itself
        connection.shutdown(sockets.SHUT_RDWR)
