"""Notify a service manager by systemd's protocol (sd_notify(3)): datagrams to `$NOTIFY_SOCKET`."""

import os
import socket
import threading
import time
from collections.abc import Mapping, MutableMapping

LOOPS = frozenset({"mapping", "publishing"})  # loops that must turn for a watchdog ping
PINGS = 3  # in the period of silence after which the manager restarts the process
LONGEST_STATUS = 400  # characters


class ServiceManager:
    """The service manager that started the process. If none asked for notifications, none are sent.

    Args:
        environment: `NOTIFY_SOCKET` is the address, `WATCHDOG_USEC` the longest silence, and `WATCHDOG_PID`
            the process watched. They are removed, as they are not meant for child processes.
    """

    def __init__(self, environment: MutableMapping[str, str]) -> None:
        self._address, self._period = _asked(environment)
        for name in ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"):
            environment.pop(name, None)
        self._lock = threading.Lock()
        self._turned: set[str] = set()  # loops that have turned since the next ping is due
        self._next_ping = 0.0

    def ready(self) -> None:
        """Say that the sockets are bound, and all loops run."""
        self._send("READY=1")

    def stopping(self) -> None:
        self._send("STOPPING=1")

    def status(self, words: str) -> None:
        """Send one line for `systemctl status`."""
        self._send("STATUS=" + " ".join(words.split())[:LONGEST_STATUS])

    def turned(self, loop: str) -> None:
        """Note that one of `LOOPS` has turned. A ping is sent when all have since the last one. When a loop
        hangs, no more are sent, and the manager restarts the process."""
        if self._period is None:
            return
        with self._lock:
            if time.monotonic() < self._next_ping:
                return
            self._turned.add(loop)
            if self._turned != LOOPS:
                return
            self._turned.clear()
            self._next_ping = time.monotonic() + self._period / PINGS
        self._send("WATCHDOG=1")

    def _send(self, message: str) -> None:
        if self._address is None:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
            sender.setblocking(False)
            try:
                sender.sendto(message.encode(), self._address)
            except OSError:
                pass  # the node does not end because its manager is busy, or gone


def _asked(environment: Mapping[str, str]) -> tuple[str | None, float | None]:
    """Return the address, and the seconds of silence after which the process is restarted; None: none."""
    address = environment.get("NOTIFY_SOCKET") or None
    if address is not None and address.startswith("@"):
        address = "\0" + address[1:]
    microseconds, watched = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID")
    if address is None or not microseconds.isdigit() or watched not in (None, str(os.getpid())):
        return address, None
    return address, int(microseconds) * 1e-6
