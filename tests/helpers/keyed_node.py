"""A publisher that streams and answers, with keys or without, and its clients."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from synthetic import publisher, stream

from sags_node.errors import SagsError
from sags_node.messaging.address import ClientKeys
from sags_node.messaging.control import ControlClient, Handler
from sags_node.messaging.publisher import Publisher
from sags_node.messaging.roles import ROLES
from sags_node.messaging.security import read_key_pair, read_public_key, write_key_pair
from sags_node.messaging.subscriber import Subscriber


def make_keys(folder: Path) -> Path:
    """node.*, stranger.*, clients/viewer.* and clients/ROLE/ROLE.*"""
    for name in ("node", "stranger", "clients/viewer", *(f"clients/{role}/{role}" for role in ROLES)):
        write_key_pair((folder / name).parent, Path(name).name)
    return folder


TOPIC = "left/depth"  # what subscribers of `Node` subscribe to


@dataclass(frozen=True)
class Node:
    """The node's side, and who connects to it by tcp: `client` names a key of `make_keys`; None: without."""

    running: Publisher
    keys: Path | None

    def of(self, client: str | None, node: str = "node") -> ClientKeys | None:
        return None if client is None or self.keys is None else of(self.keys, client, node)

    def subscriber(self, client: str | None = None, node: str = "node") -> Subscriber:
        return Subscriber([TOPIC], self.running.connection.data[-1], keys=self.of(client, node))

    def asker(self, client: str | None = None, node: str = "node") -> ControlClient:
        return ControlClient(self.running.connection.control, keys=self.of(client, node))

    @contextmanager
    def serves_on(self, client: str | None = None) -> Iterator[Subscriber]:
        """A subscriber from before to after the block loses nothing, and goes on."""
        with self.subscriber(client) as subscriber:
            assert subscriber.wait(TOPIC, 60) is not None
            yield subscriber
            assert subscriber.wait(TOPIC, 60, after=subscriber.latest(TOPIC)) is not None
            assert subscriber.lost(TOPIC) == 0 and subscriber.refusal is None


@contextmanager
def node(
    run_dir: Path, keys: Path | None = None, handlers: Mapping[str, Handler] | None = None, **config: Any
) -> Iterator[Node]:
    """A node that streams; with `keys` it lets in those in their folder `clients` only."""
    guarded = {} if keys is None else {"key": keys / "node.key", "allow": (keys / "clients",)}
    with publisher(run_dir, handlers, **guarded, **config) as running, stream(running):
        yield Node(running, keys)


def of(keys: Path, client: str, node: str = "node") -> ClientKeys:
    return ClientKeys(read_key_pair(keys / f"{client}.key"), read_public_key(keys / f"{node}.pub"))


def error_of(asker: ControlClient, op: str = "ping") -> str:
    """Why it is not answered; empty: it is."""
    try:
        asker.request(op)
    except SagsError as error:
        return str(error)
    return ""
