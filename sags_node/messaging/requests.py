"""The `args` of the control operations that consumers ask for, and their checks."""

import math
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np

from sags_node.errors import SagsError
from sags_node.geometry import is_rigid
from sags_node.messaging.topics import VIEW_NAME
from sags_node.types import F64

MAX_VIEW_SIDE = 1920  # px
MAX_VIEW_PIXELS = 1920 * 1200  # of each eye
MAX_VIEW_HZ = 60.0
MAX_AHEAD_MS = 1000.0
MAX_MEASURED = 256  # anchors at once: the mapping thread measures them
LARGEST = 1e6  # px or m: float32 can hold it and its square
MAX_DISTANCE = 10.0  # m from the world's origin or the left camera

Row = tuple[float, ...]
Name = Annotated[str, msgspec.Meta(pattern=rf"^{VIEW_NAME.pattern}\Z")]  # $ lets a line break pass
Side = Annotated[int, msgspec.Meta(ge=16, le=MAX_VIEW_SIDE)]
R = TypeVar("R", bound=msgspec.Struct)


AheadMs = Annotated[float, msgspec.Meta(ge=0, le=MAX_AHEAD_MS)] | Literal["auto"]


class AnchorRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`add_anchor`: a pixel of the left image, or a point in the world."""

    u: float | None = None  # px
    v: float | None = None
    x: float | None = None  # m
    y: float | None = None
    z: float | None = None
    ahead_ms: AheadMs = 0.0  # also publish where it is expected so much later; auto: at publication

    def __post_init__(self) -> None:
        given = {name for name in "uvxyz" if getattr(self, name) is not None}
        if given not in ({"u", "v"}, {"x", "y", "z"}):
            raise ValueError("give either a pixel {u, v} of the left image or a point {x, y, z} in metres")
        if not all(abs(getattr(self, name)) <= LARGEST for name in given):  # refuses NaN, too
            raise ValueError(f"{', '.join(sorted(given))} must be finite, and no more than {LARGEST:g}")


class AnchorName(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`remove_anchor`: an anchor by its id."""

    id: int
    session: str | None = None  # that pinned it; in another session the id is another anchor's


class MeasureRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`measure`: the anchors along a path, or around an area."""

    anchors: Annotated[tuple[int, ...], msgspec.Meta(max_length=MAX_MEASURED)]
    area: bool = False


class ViewRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`open_view`: a viewpoint, in the world or as seen from the left camera, which it then follows."""

    name: Name
    width: Side = 640
    height: Side = 512
    T_world_cam: tuple[Row, ...] | None = None  # [4][4] m
    T_left_cam: tuple[Row, ...] | None = None  # [4][4] m; default: where the left camera is
    K: tuple[Row, ...] | None = None  # [3][3] px; default: the left camera's, scaled to this size
    fov: Annotated[float, msgspec.Meta(ge=5, le=150)] | None = None  # degrees across, instead of K
    rate_hz: Annotated[float, msgspec.Meta(gt=0, le=MAX_VIEW_HZ)] = 10.0
    depth: bool = False
    static: bool = False  # draw once
    stereo: bool = False  # also draw the right eye, at the rig's baseline
    ahead_ms: AheadMs = 0.0  # draw the tissue where it is expected so much later; auto: when it is drawn
    show: Literal["tissue", "strain"] = "tissue"  # in its own colours, or in those of its strain

    def __post_init__(self) -> None:
        if self.width * self.height > MAX_VIEW_PIXELS:
            raise ValueError(
                f"{self.width}x{self.height} px is too large; at most {MAX_VIEW_PIXELS} px in all"
            )
        if self.T_world_cam is not None and self.T_left_cam is not None:
            raise ValueError("give T_world_cam or T_left_cam, not both")
        if self.K is not None and self.fov is not None:
            raise ValueError("give K or fov, not both")
        self.pose()
        self.intrinsics()

    def pose(self) -> F64:
        """The pose [4, 4] (m): `T_world_cam`, or else `T_left_cam`."""
        rows = self.T_world_cam if self.T_world_cam is not None else self.T_left_cam
        if rows is None:
            return np.eye(4)
        name = "T_left_cam" if self.T_world_cam is None else "T_world_cam"
        T = _matrix(rows, 4, name)
        if not is_rigid(T):
            raise ValueError(f"{name} must be a rotation and a translation above a last row 0 0 0 1")
        if np.linalg.norm(T[:3, 3]) > MAX_DISTANCE:
            raise ValueError(f"{name} is more than {MAX_DISTANCE:g} m away; translations are in metres")
        return T

    def intrinsics(self) -> F64 | None:
        """The intrinsics [3, 3] (px); None: those of the left camera."""
        if self.fov is not None:
            focal = 0.5 * self.width / math.tan(math.radians(0.5 * self.fov))
            centre = 0.5 * (self.width - 1), 0.5 * (self.height - 1)
            return np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
        if self.K is None:
            return None
        K = _matrix(self.K, 3, "K")
        plain = min(K[0, 0], K[1, 1]) >= 1 and K[0, 1] == K[1, 0] == 0 and tuple(K[2]) == (0, 0, 1)
        if not plain:
            raise ValueError(
                "K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in px with fx and fy of 1 or more"
            )
        return K


class SaveRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`save_model`: the file to write."""

    path: str


class _Nothing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What an operation without arguments takes."""


class ViewName(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`close_view`: a view by its name."""

    name: Name


def parse(kind: type[R], args: Mapping[str, Any]) -> R:
    """The typed request in `args`.

    Raises:
        SagsError: something is missing, unknown, of the wrong type or out of range.
    """
    try:
        return msgspec.convert(dict(args), kind)
    except (msgspec.ValidationError, RecursionError) as error:
        raise SagsError(str(error).replace("$.", "")) from None


def without_args(work: Callable[[], Any]) -> Callable[[Mapping[str, Any]], Any]:
    """Make the handler of an operation without arguments, which would have no effect: they are refused."""

    def handle(args: Mapping[str, Any]) -> Any:
        parse(_Nothing, args)
        return work()

    return handle


def _matrix(rows: tuple[Row, ...], size: int, name: str) -> F64:
    if len(rows) != size or any(len(row) != size for row in rows):
        raise ValueError(f"{name} must be {size} rows of {size} numbers")
    matrix = np.array(rows, np.float64)
    if not (np.abs(matrix) <= LARGEST).all():  # refuses NaN, too
        raise ValueError(f"{name} must be finite, and no more than {LARGEST:g}")
    return matrix
