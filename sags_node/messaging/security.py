"""Who may connect: key files, the list of allowed clients, and where a node may listen.

ZeroMQ's CURVE encrypts and authenticates both sides. A key pair is two files in ZeroMQ's certificate format:
`NAME.key` (both keys, mode 0600, never leaves its owner) and `NAME.pub` (the public key, given to others).
"""

from __future__ import annotations

import ipaddress
import logging
import re
import shlex
import struct
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import zmq
from zmq.auth import load_certificate
from zmq.auth.thread import ThreadAuthenticator
from zmq.utils import z85

from sags_node.errors import SagsError, UsageError
from sags_node.files import whole, writing
from sags_node.messaging.roles import ROLES, Client, client_of

if TYPE_CHECKING:
    from sags_node.config.schema import Guarded  # whose validation a client need not load

KEY_CHARACTERS = 40  # a CURVE key in Z85
MAX_KEY_FILE_BYTES = 4096
MAX_ALLOWED = 1000
ZAP_DOMAIN = b"sags"  # set on plain sockets too: libzmq then refuses peers of the old protocols 1 and 2
LOOK_AGAIN = 1.0  # s between checks for keys that were added or removed
LOG_PERIOD = 10.0  # s between two lines about refused connections

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A CURVE key pair in Z85; the secret half is never printed."""

    public: bytes
    secret: bytes = field(repr=False)


# ---- key files -------------------------------------------------------------------------------------------


def write_key_pair(folder: Path, name: str) -> tuple[Path, Path]:
    """Make a new key pair: `name.key` (mode 0600) and `name.pub` in `folder`.

    Raises:
        UsageError: a file of that name exists, or the name is no file name.
        SagsError: they cannot be written.
    """
    if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*", name):
        raise UsageError(f"'{name}' is no name for a key; use letters, digits, - _ and .")
    secret_file, public_file = folder / f"{name}.key", folder / f"{name}.pub"
    public, secret = (key.decode() for key in zmq.curve_keypair())
    private = f"# Secret key of a SAGS node or client; keep it to yourself.\n{_curve(public)}"
    private += f'    secret-key = "{secret}"\n'
    shared = f"# Public key of a SAGS node or client; give it to the other side.\n{_curve(public)}"
    for file in (secret_file, public_file):
        if file.exists():
            raise UsageError(f"{file} exists already; choose another name or remove it")
    with writing(folder):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    with whole(secret_file, new=True) as secret_part, whole(public_file, new=True) as public_part:
        secret_part.touch(0o600)  # from the start, so that others can never read it
        secret_part.write_text(private, encoding="ascii")
        public_part.write_text(shared, encoding="ascii")
    return secret_file, public_file


def _curve(public: str) -> str:
    return f'curve\n    public-key = "{public}"\n'


def read_key_pair(file: Path) -> KeyPair:
    """The key pair in a `.key` file.

    Raises:
        UsageError: the file is missing, open to others or holds no key pair.
    """
    public, secret = _read(file)
    if secret is None:
        raise UsageError(f"{file} holds no secret key; give the .key file that sags keygen wrote")
    if file.stat().st_mode & 0o077:
        raise UsageError(f"{file} can be read by others; run: chmod 600 {shlex.quote(str(file))}")
    if not _is_key(secret) or zmq.curve_public(secret) != public:
        raise UsageError(f"{file} is damaged; make a new key pair with sags keygen")
    return KeyPair(public, secret)


def read_public_key(file: Path) -> bytes:
    """The key in a `.pub` file, Z85.

    Raises:
        UsageError: the file is missing, holds no key, or holds a secret one.
    """
    public, secret = _read(file)
    if secret is not None:
        raise UsageError(f"{file} holds a secret key; use the .pub file, and keep this one where it was made")
    return public


def public_key(said: str) -> bytes:
    """A public key given as its 40 characters or as the path of its `.pub` file, Z85.

    Raises:
        UsageError: neither.
    """
    return said.encode() if _is_key(said.encode()) else read_public_key(Path(said))


def read_allow_list(places: Sequence[Path], section: str = "publish") -> dict[bytes, Client]:
    """The clients that may connect, by public key (Z85), from `.pub` files and folders of them.

    Raises:
        UsageError: there is none, there are too many, a file is no public key, or anybody may add one.
    """
    files = _files(places, section)
    folders = [place / folder for place in places for folder in ("", *ROLES)]
    for place in (*files, *filter(Path.is_dir, folders)):
        if place.exists() and place.stat().st_mode & 0o002:
            raise UsageError(
                f"{section}.allow: anybody may write to {place}, and so let himself in; run: chmod o-w "
                f"{shlex.quote(str(place))}"
            )
    if not files:
        where = ", ".join(str(place) for place in places)
        raise UsageError(
            f"{section}.allow: no .pub file in {where}; put the public keys of the clients there"
        )
    if len(files) > MAX_ALLOWED:
        raise UsageError(f"{section}.allow: {len(files)} keys; at most {MAX_ALLOWED} are allowed")
    return _by_key((read_public_key(file), client_of(file)) for file in files)


def _by_key(listed: Iterable[tuple[bytes, Client]]) -> dict[bytes, Client]:
    """The clients by key; a key in several folders has the lowest role of them."""
    return dict(sorted(listed, key=lambda one: -one[1].rank))


def _read(file: Path) -> tuple[bytes, bytes | None]:
    """Public and, if there is one, secret key of a certificate file; only the public one is checked."""
    try:
        if not file.exists():
            raise UsageError(f"there is no key file {file}; check the path, or make a pair with sags keygen")
        if not file.is_file() or file.stat().st_size > MAX_KEY_FILE_BYTES:
            raise UsageError(f"{file} is no key file; make a key pair with sags keygen")
        public, secret = load_certificate(file)
    except OSError as error:
        raise UsageError(f"cannot read key {file}: {error.strerror}; check the path") from None
    except (ValueError, IndexError):
        public, secret = b"", None
    if not _is_key(public):
        raise UsageError(f"{file} holds no key; make a key pair with sags keygen")
    return public, secret


def _is_key(key: bytes) -> bool:
    try:
        return len(key) == KEY_CHARACTERS and len(z85.decode(key)) == 32
    except (KeyError, ValueError, struct.error):
        return False


_OPEN = {
    "publish": "anybody who reaches it sees the video and controls the node",
    "source": "anybody who reaches it says what the scope sees",
    "robot": "anybody who reaches it says where the scope is",
}

# ---- the node's side -------------------------------------------------------------------------------------


def check_endpoint(endpoint: str, config: Guarded, section: str = "publish") -> None:
    """Refuse an endpoint that other machines can reach, unless it needs listed keys or is `insecure`.

    Args:
        section: of the launch file, from which `config` is; for the message.

    Raises:
        UsageError: not tcp or ipc, or not loopback while neither keys are set nor `insecure`.
    """
    transport, separator, address = endpoint.partition("://")
    port = address.rpartition(":")[2]  # of tcp; ZeroMQ takes 99999 and binds another one
    is_port = transport == "ipc" or port == "*" or (port.isdecimal() and int(port) < 1 << 16)
    if not separator or transport not in ("tcp", "ipc") or not address or not is_port:
        raise UsageError(f"'{endpoint}' is no endpoint; write tcp://127.0.0.1:PORT or ipc:///PATH")
    if transport == "ipc" and address.startswith("@"):
        raise UsageError(f"{endpoint} is open to every user of this machine; write ipc:///PATH")
    if config.key is not None or is_local(endpoint):
        return
    if not config.insecure:
        raise UsageError(
            f"{endpoint} can be reached from other machines: set {section}.key and {section}.allow (see "
            f"sags keygen), or {section}.insecure:=true ({_OPEN[section]})"
        )
    log.warning("%s is open: %s", endpoint, _OPEN[section])


def is_local(endpoint: str) -> bool:
    """Tell whether only this machine can be at the other end."""
    transport, _, address = endpoint.partition("://")
    return transport == "ipc" or (transport == "tcp" and is_loopback(address.rpartition(":")[0].strip("[]")))


def is_loopback(host: str) -> bool:
    """Tell whether only this machine can reach a server on this address."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class RateLimitedLog:
    """Limits log lines to one per `LOG_PERIOD`, so that no stranger can fill the log."""

    def __init__(self) -> None:
        self._next = 0.0

    def due(self) -> bool:
        """Tell whether a line may be logged now: at most once per `LOG_PERIOD`."""
        now = time.monotonic()
        if now < self._next:
            return False
        self._next = now + LOG_PERIOD
        return True


class AllowList:
    """The keys that may connect, by their files as they are now; used from several threads.

    A file that is added or removed takes effect within `LOOK_AGAIN` s. A file that cannot be used then lets
    nobody in, and does not affect the other files.

    Raises:
        UsageError: at the start, as `read_allow_list`.
    """

    def __init__(self, places: Sequence[Path], section: str) -> None:
        self._places, self._section = places, section
        self._allowed = read_allow_list(places, section)
        self._lock = threading.Lock()
        self._seen = _versions(places, section)
        self._next_look = 0.0
        self._revocations = 0
        self._seldom = RateLimitedLog()

    def callback(self, domain: str, key: bytes) -> bool:
        """Tell the authenticator whether a key may connect."""
        self._look()
        if key not in self._allowed and self._seldom.due():
            log.warning(
                "refused a client with the key %s, which is not in %s.allow", key.decode(), self._section
            )
        return key in self._allowed

    def client(self, key: bytes) -> Client | None:
        """The client that has this key, as of the last look at the files; None: it is not on the list."""
        return self._allowed.get(key)

    def revocations(self) -> int:
        """How often keys have been taken off the list since the start."""
        self._look()
        return self._revocations

    def _look(self) -> None:
        with self._lock:
            if time.monotonic() < self._next_look:
                return
            self._next_look = time.monotonic() + LOOK_AGAIN
            versions = _versions(self._places, self._section)
            if versions == self._seen:
                return
            self._seen = versions
            before, self._allowed = self._allowed, _by_key(_usable(versions))
            gone = [str(client) for key, client in before.items() if key not in self._allowed]
            self._revocations += bool(gone)
            new = [str(client) for key, client in self._allowed.items() if before.get(key) != client]
        log.warning(
            "%s.allow has changed; new, or with another role: %s; no longer let in: %s",
            self._section, ", ".join(new) or "none", ", ".join(gone) or "none",
        )  # fmt: skip


def _versions(places: Sequence[Path], section: str) -> dict[Path, tuple[int, int]]:
    """The files of an allow list, with what changes when one is written: mtime (ns) and inode."""
    found = {}
    for file in _files(places, section):
        with suppress(OSError):  # it has just gone
            found[file] = (file.stat().st_mtime_ns, file.stat().st_ino)
    return found


def _usable(files: Iterable[Path]) -> Iterator[tuple[bytes, Client]]:
    for file in files:
        try:
            yield read_public_key(file), client_of(file)
        except UsageError as error:
            log.warning("%s", error)


def _files(places: Sequence[Path], section: str) -> list[Path]:
    """The key files. Only `publish` has folders of roles; senders of images or poses have no role."""
    within = ("", *ROLES) if section == "publish" else ("",)
    files: list[Path] = []
    for place in places:
        if place.is_dir():
            files += [file for folder in within for file in sorted((place / folder).glob("*.pub"))]
        else:
            files.append(place)
    return files


@dataclass(frozen=True, slots=True)
class Gate:
    """Who may connect to bound sockets.

    Attributes:
        keys: the node's; None: everybody who reaches the sockets may connect.
        revocations: how often keys were taken off the list. Connected peers must then authenticate again.
        client: returns whose public key that is; None: it is not on the list.
    """

    keys: KeyPair | None = None
    revocations: Callable[[], int] = lambda: 0
    client: Callable[[bytes], Client | None] = lambda _: None


@contextmanager
def authenticated(
    context: zmq.Context[zmq.Socket[bytes]], config: Guarded, section: str = "publish"
) -> Iterator[Gate]:
    """Authenticate peers during the block: where `key` is set, only the keys of `allow` are let in.

    Args:
        section: of the launch file, from which `config` is; for messages.

    Raises:
        UsageError: a key file is missing, damaged or open to others, or nobody is allowed.
        SagsError: this ZeroMQ library was built without CURVE.
    """
    if config.key is None:
        yield Gate()
        return
    if not zmq.has("curve"):
        raise SagsError("this ZeroMQ library has no CURVE; install pyzmq from its wheel")
    keys = read_key_pair(config.key)
    allowed = AllowList(config.allow, section)
    authenticator = ThreadAuthenticator(context)
    authenticator.configure_curve_callback(ZAP_DOMAIN.decode(), allowed)
    authenticator.start()
    try:
        yield Gate(keys, allowed.revocations, allowed.client)
    finally:
        authenticator.stop()
