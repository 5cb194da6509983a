"""What `sags overlay` draws: a YAML file of objects and the anchors that hold them, typed and validated."""

from pathlib import Path
from typing import Annotated, Literal, Self, TypeVar, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from sags_node.config.launch_file import explain
from sags_node.config.schema import Section
from sags_node.config.yaml_reader import read_yaml
from sags_node.errors import UsageError

ALARM: tuple[int, int, int] = (255, 70, 40)  # RGB, of a zone that a tip is too near to
WIDEST_MARGIN = 0.05  # m
LONGEST_LABEL = 64  # characters
KEY_DISTANCE = 64  # of 255: an object's colour nearer than this to the key colour could be taken for it

Place = tuple[float, float, float]  # m
Byte = Annotated[int, Field(ge=0, le=255)]
Shape = Literal["target", "sphere"]
SHAPES: tuple[str, ...] = get_args(Shape)
S = TypeVar("S", bound=Section)


def _in_bytes(value: object) -> object:
    if not isinstance(value, list | tuple) or not all(isinstance(each, int | float) for each in value):
        return value
    if len(value) == 4:
        raise ValueError("a colour is [red, green, blue]; how opaque it is says `opacity:`, 0..1")
    if value and 0 < max(value) <= 1:
        raise ValueError(f"a colour is bytes of 0..255, this is {list(value)}; multiply 0..1 by 255")
    return value


Color = Annotated[tuple[Byte, Byte, Byte], BeforeValidator(_in_bytes)]  # RGB


def _margin(value: float) -> float:
    if not 0 < value <= WIDEST_MARGIN:
        raise ValueError(
            f"a margin is in metres, above 0 and at most {WIDEST_MARGIN:g}, it is {value:g}; for 5 mm write "
            "0.005"
        )
    return value


Margin = Annotated[float, AfterValidator(_margin)]


class AnchorSpec(Section):
    """One point of the tissue that holds an object."""

    pixel: tuple[float, float] | None = Field(None, description="u v of the left image, first good frame")
    place: Place | None = Field(None, description="x y z in the world, m")
    at: Place | None = Field(None, description="the point of the object that lies there, see `at_units`")

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if (self.pixel is None) == (self.place is None):
            raise ValueError("an anchor needs either pixel: [u, v] or place: [x, y, z]")
        return self


class Registered(BaseModel):
    """The part of `sags register`'s result that the overlay uses; the rest is for people."""

    model_config = ConfigDict(extra="allow", frozen=True, allow_inf_nan=False)
    residual_p90_mm: float | None = Field(None, ge=0)
    share: float = Field(1.0, gt=0, le=1)
    session: str | None = Field(None, description="of the node, in whose world its places are")
    epoch: int | None = Field(None, ge=0, description="of that node")


class ObjectSpec(Section):
    """A mesh, a point cloud, a built-in shape or a mere label, fixed to the tissue."""

    file: Path | None = Field(None, description="mesh (.ply .obj .stl) or points (.ply .pcd .xyz)")
    shape: Shape | None = None
    label: Annotated[str, Field(min_length=1, max_length=LONGEST_LABEL)] | None = None
    color: Color = (255, 210, 40)
    opacity: float = Field(0.85, gt=0, le=1)
    scale: float = Field(1.0, gt=0, le=1000, description="metres per unit of the file")
    point_size: float = Field(5e-4, gt=0, le=0.01, description="radius of each point of a point cloud, m")
    at_units: Literal["file", "m"] | None = Field(
        None,
        description="of every `at`: those of the file, as `scale` says, or metres; default: the file's, or "
        "metres where only these fit, as scene files had it before",
    )
    coordinates: Literal["camera", "world"] = Field(
        "camera",
        description="of the file when three or more anchors hold it and none says `at`: the left camera's "
        "when it is pinned, or the world's",
    )
    anchors: tuple[AnchorSpec, ...] = Field((), max_length=32, description="one, or three and more; default: "
                                            "one in the middle of the tissue")  # fmt: skip
    deform: bool = Field(False, description="bend it with the tissue over it")
    deform_depth_mm: float = Field(15.0, gt=0, le=100, description="below the surface it stays rigid")
    registration: Registered | None = Field(None, description="what sags register found")
    margin: Margin | None = Field(
        None, description="m; it is a forbidden zone: tips of instruments that are nearer are told"
    )

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.file is None and self.shape is None and self.label is None:
            raise ValueError("an object needs a file, a shape or a label")
        if self.file is not None and self.shape is not None:
            raise ValueError("an object has a file or a shape, not both")
        of_files = {"scale", "point_size"} | ({"at_units"} if self.at_units == "file" else set())
        if self.file is None and (named := sorted(of_files & self.model_fields_set)):
            raise ValueError(f"{named[0]} is of a file, which this object has not: leave it out")
        if len(self.anchors) == 2:
            raise ValueError("two anchors leave it free to turn: give one, or three and more")
        if self.deform and (len(self.anchors) < 3 or (self.file is None and self.shape is None)):
            raise ValueError("deform: true needs a file, and three anchors or more that hold it")
        if "deform_depth_mm" in self.model_fields_set and not self.deform:
            raise ValueError("deform_depth_mm says how deep `deform: true` reaches: add it")
        if self.margin is not None and self.file is None and self.shape is None:
            raise ValueError("margin makes a forbidden zone of a file or a shape: add one")
        said = [anchor.at is not None for anchor in self.anchors]
        if len(said) > 1 and any(said) and not all(said):
            raise ValueError("either every anchor says `at`, or none does")
        if "coordinates" in self.model_fields_set and (len(said) < 3 or any(said)):
            raise ValueError("coordinates is for three anchors or more of which none says `at`: leave it out")
        return self

    @property
    def name(self) -> str:
        return self.label or (self.file.name if self.file is not None else str(self.shape))


class SceneSpec(Section):
    objects: tuple[ObjectSpec, ...] = Field(min_length=1, max_length=32)
    color_key: Color = Field((0, 0, 255), description="RGB that a display replaces by the video")

    tissue_margin: Margin | None = Field(
        None, description="m; tips of instruments that are nearer to tissue are told, and all distances drawn"
    )

    @property
    def asks_for_instruments(self) -> bool:
        """Tell whether it has margins, for which tips of instruments are needed."""
        return self.tissue_margin is not None or any(thing.margin is not None for thing in self.objects)

    @model_validator(mode="after")
    def _colors_apart(self) -> Self:
        shown = [(thing.name, thing.color) for thing in self.objects]
        if self.asks_for_instruments:
            shown.append(("what a tip is too near to", ALARM))
        for name, color in shown:
            if max(abs(a - b) for a, b in zip(color, self.color_key, strict=True)) < KEY_DISTANCE:
                raise ValueError(
                    f"the colour of {name} {list(color)} is too near the key colour "
                    f"{list(self.color_key)}: a display would replace it by the video"
                )
        return self


class PairSpec(Section):
    """A point of the tissue, and the point of a model that belongs there."""

    pixel: tuple[float, float] | None = Field(None, description="u v of left/image_rect_color")
    anchor: int | None = Field(None, description="number of an anchor of the node")
    at: Place = Field(description="of the model, in the file's units")

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if (self.pixel is None) == (self.anchor is None):
            raise ValueError("a pair needs either pixel: [u, v] or anchor: NUMBER")
        return self


class PairsSpec(Section):
    pairs: tuple[PairSpec, ...] = Field(max_length=100)
    targets: tuple[Place, ...] = Field(
        (), max_length=32, description="points of the model whose error is told"
    )


def built_in(pixel: tuple[float, float] | None, shape: str) -> SceneSpec:
    """Return a scene of one shape at a pixel, or in the middle of the tissue.

    Raises:
        UsageError: there is no such shape, or the pixel is not finite.
    """
    if shape not in SHAPES:
        raise UsageError(f"unknown shape '{shape}'; shapes: {', '.join(SHAPES)}")
    anchors = [] if pixel is None else [{"pixel": pixel}]
    return checked(SceneSpec, {"objects": [{"shape": shape, "anchors": anchors}]}, "built-in scene")


def read_scene(file: Path) -> SceneSpec:
    """Read a scene file; the files it names are relative to it.

    Raises:
        UsageError: it is missing or too large, is not YAML, or holds an unknown key or a wrong value.
    """
    scene, folder = _read(SceneSpec, file, "scene file"), file.parent
    located = [
        thing if thing.file is None else thing.model_copy(update={"file": folder / thing.file})
        for thing in scene.objects
    ]
    return scene.model_copy(update={"objects": tuple(located)})


def read_pairs(file: Path) -> PairsSpec:
    """Read the pairs of points of a registration.

    Raises:
        UsageError: as `read_scene`.
    """
    return _read(PairsSpec, file, "file of pairs")


def _read(root: type[S], file: Path, what: str) -> S:
    return checked(root, read_yaml(file, what), file)


def checked(root: type[S], tree: object, where: object) -> S:
    """Return the section that these values make.

    Args:
        where: where they stand, for the message.

    Raises:
        UsageError: an unknown key or a wrong value.
    """
    try:
        return root.model_validate(tree)
    except ValidationError as error:
        raise UsageError(explain(error, where, root=root, page="")) from None
