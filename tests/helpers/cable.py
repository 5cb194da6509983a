"""What lies between a node and its client: a connection that can be cut, and that may be slow."""

import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Self


class Cable:
    """Passes connections on. Those that are open when it is cut stay open, and silent.

    Args:
        delay: s by which the next bytes come later, each way.
    """

    def __init__(self, endpoint: str, delay: Callable[[], float] = lambda: 0.0) -> None:
        self._delay = delay
        host, port = endpoint.removeprefix("tcp://").split(":")
        self._far = (host, int(port))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"
        self.connections = 0
        self._open: list[socket.socket] = []
        self._cut = threading.Event()
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    def cut(self) -> None:
        self._cut.set()
        self._cut = threading.Event()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            far = socket.create_connection(self._far)
            self.connections += 1
            self._open += [near, far]
            for source, target in ((near, far), (far, near)):
                passing = threading.Thread(target=self._pass, args=(source, target, self._cut))
                self._threads.append(passing)
                passing.start()

    def _pass(self, source: socket.socket, target: socket.socket, cut: threading.Event) -> None:
        try:
            while (data := source.recv(65536)) and not cut.is_set():
                time.sleep(self._delay())
                target.sendall(data)
        except OSError:
            return

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        for one in (self._listener, *self._open):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()
        for thread in self._threads:
            thread.join()
