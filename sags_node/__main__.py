"""The `sags` command, also as `python -m sags_node`, from its first moment on: loading it takes a while."""

import atexit
import os
import signal
import sys
import threading


def main() -> None:
    """Run the command. A Ctrl-C while it is being loaded ends it at once: nothing has begun yet."""
    code: object = 1  # of an error that Python prints

    def end() -> None:
        """Python itself would break a daemon thread off inside OpenCV, whose code answers with SIGABRT."""
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
        raise


def _leave(number: int, frame: object) -> None:
    os.write(2, b"stopped\n")
    os._exit(130)


if __name__ == "__main__":
    main()
