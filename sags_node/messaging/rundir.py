"""The run directory: private to its owner, it holds the ipc socket, a lock and the connection file.

The connection file tells a client on this machine where the node is:
`{protocol, ns, session, pid, data: [endpoints], control: endpoint | null, public_key: Z85 | null,
recording: path | null}`.
"""

import fcntl
import os
import shlex
import stat
from pathlib import Path

import msgspec

from sags_node.errors import SagsError, UsageError
from sags_node.files import whole
from sags_node.messaging.sockets import OWN_SOCKETS

MAX_CONNECTION_FILE_BYTES = 16384
MAX_UNIX_SOCKET_PATH = 107  # bytes, sun_path of Linux without its final zero
OPTION = "publish.run_dir (sags bag play: --run-dir)"


class NoNodeError(SagsError):
    """No node with that name runs here."""


class Connection(msgspec.Struct, frozen=True, kw_only=True):
    """What a client needs to reach a node."""

    protocol: str
    ns: str
    session: str
    pid: int
    data: list[str]  # XPUB endpoints, the quickest first
    control: str | None
    public_key: str | None = None  # Z85; set when the tcp endpoints speak CURVE
    recording: str | None = None  # what `sags bag play` plays there, instead of a node


def default_run_dir() -> Path:
    """`$XDG_RUNTIME_DIR/sags`, or `/tmp/sags-<uid>` where there is none."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    return Path(runtime) / "sags" if runtime else Path(f"/tmp/sags-{os.getuid()}")


def private_directory(path: Path) -> Path:
    """Make `path` with mode 0700, or check that nobody else can write in it.

    Raises:
        UsageError: it is a link, belongs to somebody else or is open to others, or cannot be made.
    """
    other = f"choose another with {OPTION}"
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        info = path.lstat()
    except OSError as error:
        raise UsageError(f"run directory {path}: {error.strerror}; {other}") from None
    if not stat.S_ISDIR(info.st_mode) or info.st_uid != os.getuid():
        raise UsageError(f"run directory {path} is not a directory of yours; {other}")
    if info.st_mode & 0o077:
        raise UsageError(
            f"run directory {path} is open to other users; run: chmod 700 {shlex.quote(str(path))}"
        )
    return path


class RunDirectory:
    """One node's place in the run directory, from start to `close`; taken again when somebody removes it.

    Raises:
        SagsError: another live node holds the same namespace.
        UsageError: see `private_directory`.
    """

    def __init__(self, path: Path | None, ns: str) -> None:
        self.folder = (path or default_run_dir()).absolute()  # clients in other folders find it too
        self._ns = ns
        self.connection_file = connection_path(self.folder, ns)
        self.ipc_path = self.connection_file.with_suffix(".ipc")
        self._lock_path = self.connection_file.with_suffix(".lock")
        self._lock = self._take()

    def _take(self) -> int:
        """The descriptor of the locked lock file."""
        private_directory(self.folder)
        lock = os.open(self._lock_path, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(lock)
            raise SagsError(
                f"another node already runs as '{self._ns}' in {self.folder}; stop it, or start this one "
                f"with ns:=NAME {OWN_SOCKETS} (sags overlay: --own-ns NAME; sags bag play: --ns NAME "
                "--endpoint 'tcp://127.0.0.1:*')"
            ) from None
        return lock

    @property
    def is_held(self) -> bool:
        """Tell whether the lock file in the directory is the one that this node has locked."""
        try:
            return os.path.samestat(os.fstat(self._lock), os.stat(self._lock_path))
        except OSError:
            return False

    def take_again(self) -> None:
        """Make the directory and the locked file again, if they were removed.

        Raises:
            SagsError: another node has taken the place meanwhile.
            UsageError: see `private_directory`.
        """
        if not self.is_held:
            lock = self._take()
            os.close(self._lock)
            self._lock = lock

    @property
    def ipc_endpoint(self) -> str:
        """The endpoint to bind the ipc socket to.

        Raises:
            UsageError: the path is too long for a Unix socket.
        """
        if len(os.fsencode(self.ipc_path)) > MAX_UNIX_SOCKET_PATH:
            raise UsageError(f"{self.ipc_path} is too long for a socket; set {OPTION} or publish.ipc:=false")
        return f"ipc://{self.ipc_path}"

    def write_connection(self, connection: Connection) -> None:
        """Replace the connection file in one step, mode 0600.

        Raises:
            SagsError: it cannot be written.
        """
        with whole(self.connection_file) as partial:
            partial.touch(0o600)
            partial.write_bytes(msgspec.json.encode(connection))

    def close(self) -> None:
        if self.is_held:  # else they are another node's
            self.connection_file.unlink(missing_ok=True)
            self.ipc_path.unlink(missing_ok=True)
        os.close(self._lock)


def connection_path(folder: Path, ns: str) -> Path:
    return folder / f"{ns.strip('/').replace('/', '.')}.json"


def read_connection(ns: str, run_dir: Path | None = None) -> Connection:
    """Return how to reach the node named `ns` on this machine.

    Raises:
        UsageError: others may have written the file.
        NoNodeError: no node with that name runs here.
        SagsError: its file is damaged.
    """
    folder = run_dir or default_run_dir()
    file = connection_path(folder, ns)
    try:
        _check_ours(folder, folder.stat(), folder.lstat().st_uid)  # first: then no pipe of others is there
        with file.open("rb") as opened:
            _check_ours(file, info := os.fstat(opened.fileno()), info.st_uid)
            content = opened.read(MAX_CONNECTION_FILE_BYTES)
    except OSError:
        raise NoNodeError(f"no node runs as '{ns}' (no {file}); start one with: sags run") from None
    try:
        return msgspec.json.decode(content, type=Connection)
    except (msgspec.MsgspecError, UnicodeError):
        raise SagsError(f"{file} is damaged; restart the node to write it again") from None


def _check_ours(path: Path, info: os.stat_result, linked_by: int) -> None:
    """Raise UsageError for what anybody but this user or root may have written. Anybody can make a folder or
    a link in /tmp, and name his own node there."""
    if not {info.st_uid, linked_by} <= {os.getuid(), 0} or info.st_mode & 0o022:
        raise UsageError(
            f"{path} is not yours alone, so it is not believed where the node is; say it (--endpoint and "
            f"--control), or run: chmod go-w {shlex.quote(str(path))}, if it is yours"
        )
