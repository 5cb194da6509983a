"""A publisher that lets in listed keys only, and the keys of its clients."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from synthetic import publisher

from sags_node.errors import SagsError
from sags_node.messaging.address import ClientKeys
from sags_node.messaging.control import ControlClient
from sags_node.messaging.publisher import Publisher
from sags_node.messaging.roles import ROLES
from sags_node.messaging.security import read_key_pair, read_public_key, write_key_pair


def make_keys(folder: Path) -> Path:
    """node.*, stranger.*, clients/viewer.* and clients/ROLE/ROLE.*"""
    for name in ("node", "stranger", "clients/viewer", *(f"clients/{role}/{role}" for role in ROLES)):
        write_key_pair((folder / name).parent, Path(name).name)
    return folder


@contextmanager
def secured(run_dir: Path, keys: Path, **config: Any) -> Iterator[Publisher]:
    with publisher(run_dir, key=keys / "node.key", allow=(keys / "clients",), **config) as running:
        yield running


def of(keys: Path, client: str, node: str = "node") -> ClientKeys:
    return ClientKeys(read_key_pair(keys / f"{client}.key"), read_public_key(keys / f"{node}.pub"))


def error_of(asker: ControlClient, op: str = "ping") -> str:
    """Why it is not answered; empty: it is."""
    try:
        asker.request(op)
    except SagsError as error:
        return str(error)
    return ""
