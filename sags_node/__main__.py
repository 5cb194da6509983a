"""The `sags` command, also as `python -m sags_node`, from its first moment on: loading it takes a while."""

import os
import signal


def main() -> None:
    """Run the command. A Ctrl-C while it is being loaded ends it at once: nothing has begun yet."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else it is ignored, as after nohup
        signal.signal(signal.SIGINT, _leave)
    from sags_node.cli.main import main as sags

    sags()


def _leave(number: int, frame: object) -> None:
    os.write(2, b"stopped\n")
    os._exit(130)


if __name__ == "__main__":
    main()
