"""The Ray instance that an archive runs on: one started on this machine, or an existing cluster."""

import logging
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

from sags_node.errors import SagsError, UsageError, install

NEEDED = ("ray", "pyarrow", "fsspec")  # the extra `archive`
OBJECT_STORE = 80 << 20  # bytes: tasks pass nothing large; Ray needs at least 75 MiB
QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_DEDUP_LOGS": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
LOCAL = {
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",  # its sockets are of loopback only
    "RAY_AUTH_MODE": "token",  # other users of this machine are kept out
}


def check_installed() -> None:
    """Check, before anything else is done, that the packages are there.

    Raises:
        UsageError: a package that archives need is not installed.
    """
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        raise UsageError(f"archives need {', '.join(missing)}, which is not installed: {install('lab')}")


@contextmanager
def connected(address: str | None) -> Iterator[Any]:
    """Start Ray on this machine for as long as the context lasts, or connect to a cluster.

    Where this process is connected already, that connection is used, and stays open.

    Args:
        address: HOST:PORT of the cluster's head; None: this machine alone, by loopback only.

    Raises:
        UsageError: Ray is not installed.
        SagsError: it does not start, or there is no cluster.
    """
    check_installed()
    os.environ.update(QUIET)
    if address is None:
        os.environ.update(LOCAL | {"RAY_AUTH_TOKEN": secrets.token_hex(32)})
    import ray  # it reads the environment

    if ray.is_initialized():
        yield ray
        return
    where = {"address": address} if address else {"address": "local", "object_store_memory": OBJECT_STORE}
    try:
        ray.init(
            **where,
            **({} if address else {"include_dashboard": False}),
            log_to_driver=False,
            configure_logging=True,
            logging_level=logging.ERROR,
        )
    except Exception as error:  # of any kind: sockets, versions, memory
        what = f"Ray does not start on {address or 'this machine'}: {error}"
        raise SagsError(f"{what}; ray status --address HOST:PORT tells whether a cluster answers") from None
    try:
        yield ray
    finally:
        ray.shutdown()
