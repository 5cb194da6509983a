"""The entry point of `sags` and `python -m sags_node`: sets up stderr and Ctrl-C before the slow imports."""

import atexit
import errno
import io
import os
import signal
import sys
import threading
from typing import Any


class _Messages(io.FileIO):
    """The file behind stderr. On a full disk or a closed terminal messages are lost, and the work goes on."""

    def write(self, said: Any) -> int:
        try:
            return super().write(said)
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EIO):
                raise
            return len(said)


def main() -> None:
    """Run the command. A Ctrl-C while it is being loaded ends it at once: nothing has begun yet."""
    code: object = 1  # of an error that Python prints
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # closed: else the next file that is opened gets what libraries print
            setattr(sys, name, open(os.open(os.devnull, os.O_RDWR), mode, closefd=False))
    messages: Any = _Messages(2, "w", closefd=False)  # it has all that TextIOWrapper needs
    sys.stderr = io.TextIOWrapper(messages, sys.stderr.encoding, "backslashreplace", write_through=True)

    def end() -> None:
        """Exit at once: Python would stop a daemon thread inside OpenCV, which ends in SIGABRT."""
        if any(thread.daemon for thread in threading.enumerate()):
            print(end="", flush=True)
            print(end="", flush=True, file=sys.stderr)
            os._exit(code if isinstance(code, int) else 1)

    atexit.register(end)  # the first one, so it runs last
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else it is ignored, as after nohup
        signal.signal(signal.SIGINT, _leave)
    from sags_node.cli.main import main as sags

    try:
        sags()
    except SystemExit as ended:
        code = ended.code
        # Python remembers a Ctrl-C inside `exec` of a text, even one that was caught, until the next text:
        # `python -m` would end as killed by SIGINT.
        exec("")
        raise


def _leave(number: int, frame: object) -> None:
    os.write(2, b"stopped\n")
    os._exit(130)


if __name__ == "__main__":
    main()
