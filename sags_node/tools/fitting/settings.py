"""What can be chosen about a fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from operator import attrgetter
from typing import Any, Literal

from pydantic import TypeAdapter, ValidationError

from sags_node.config.yaml_reader import parse_word
from sags_node.errors import UsageError
from sags_node.field.decoder import Block, Tokens
from sags_node.field.deformation import FieldRates
from sags_node.field.losses import LossWeights
from sags_node.tools.fitting.residuals import room

Schedule = Literal["paper", "online"]
Part = Literal["means", "log_scales", "quats", "colors", "logits"]  # of a Gaussian's parameters

PARTS: tuple[Part, ...] = ("means", "log_scales", "quats", "colors", "logits")


LEAST = 60_000  # Gaussians at least: small images gain from more per pixel, and are drawn quickly
# Iterations after an online start for each training frame, and at least and at most how many
# (`benchmarks/fit.md`).
ITERATIONS_EACH, ITERATIONS = 12, (2000, 8000)
PATH_EVERY = 3  # training frames from one time of the paths to the next
STEREO = LossWeights(coverage=0.1)
MONOCULAR = {"inverse_depth": 0.0, "correlation": 1e-3}  # weights for depth up to scale and shift


@dataclass(frozen=True, slots=True)
class Units:
    """The change that a decoder output of 1 stands for. Adam's steps have a fixed length in these units, so
    they set how fast each part is learnt, and how much it jitters. 0: that part is not deformed."""

    mean: float = 0.01  # m
    log_scale: float = 1.0
    quat: float = 1.0
    color: float = 1.0
    logit: float = 1.0


@dataclass(frozen=True, slots=True)
class FieldShape:
    """The shape of the HexPlane, and the units of its decoder's output."""

    levels: int = 2
    cells: int = 64  # along each axis, coarsest level
    channels: int = 32  # of each level
    # Frames of the clip per slot of time. By default each slot has two of the times of `path_frames`: nothing
    # would constrain a slot without any.
    frames_per_slot: float = 7.0
    most_slots: int | None = None  # however long the clip is
    first_values: tuple[float, float] = (0.7, 1.3)  # of the planes in space, at random between these
    units: Units = Units()
    xavier: bool = False  # whether the last layers start at random, rather than at 0

    def slots(self, frames: int) -> int:
        """The number of time slots for a clip of `frames` frames."""
        slots = max(2, math.ceil(frames / self.frames_per_slot) + 1)
        return slots if self.most_slots is None else min(slots, self.most_slots)


@dataclass(frozen=True, slots=True)
class RowRates:
    """Learning rates of canonical Gaussians."""

    mean_px: float = 0.08  # in px at the tissue's median depth
    log_scale: float = 5e-3
    quat: float = 1e-3
    color: float = 2.5e-3  # of RGB 0..1; not used with slopes: colours then have a closed form
    logit: float = 0.05
    decaying: tuple[Part, ...] = PARTS  # parts whose rates fall with the field's; the others stay


@dataclass(frozen=True, slots=True)
class Growth:
    """The start and the densification of canonical Gaussians; only with schedule = paper."""

    first: int | None = 30_000  # Gaussians to begin with; None: as many as there may be
    opacity: float = 0.1  # of those
    scale: float = 1.0  # of those, in distances to their neighbours
    every: int = 300  # iterations from one densification to the next
    until: float = 0.5  # share of a stage's iterations after which it ends
    share: float = 0.1  # of the Gaussians that are split at a time, at most


@dataclass(frozen=True, slots=True)
class FitSettings:
    """The defaults are those of the online start; `PRESETS` has the others."""

    schedule: Schedule = "online"  # how it starts: see `fitting.start`
    warm_up: int = 1000  # iterations on the first frame without deformation; only with schedule = paper
    iterations: int = 2000  # on all training frames, with deformation
    # Iterations before these on images of half the size, as a multiple of `iterations`, with a quarter of
    # the Gaussians; the warm-up then uses such an image, too. Only with schedule = paper; 0: none.
    coarse: float = 0.0
    tokens: Tokens = "nodes"
    block: Block = "adaptive"  # what stands before the decoder's heads
    antialias: bool = True  # both filters
    max_gaussians: int = 1_000_000
    # px of tissue for each Gaussian. There are at least LEAST and at most max_gaussians; after an online
    # start also at most `residuals.room`. 0: always max_gaussians.
    pixels_each: float = 3.3
    seed: int = 0
    shape: FieldShape = FieldShape()
    rates: RowRates = RowRates()  # after an online start only mean_px and log_scale
    field_rates: FieldRates = field(default_factory=FieldRates)
    decay: float = 0.01  # rates that decay fall to this share of their first values
    # Iterations in which they fall so far; None: a stage's. Only with schedule = paper, and without `stable`.
    decay_over: int | None = None
    # Only with schedule = paper: share of a stage after which they fall linearly (Hu et al. 2024, MiniCPM,
    # section 4); None: they fall exponentially from the start.
    stable: float | None = None
    growth: Growth = Growth()
    midway: bool = False  # also learn images half way between training frames, see `fitting.midway`
    batch_size: int = 1  # frames of an iteration, whose losses are added; only with schedule = paper
    weights: LossWeights = STEREO  # only with schedule = paper
    color_softness: float = 0.0  # of RGB 0..1, see `field.losses.compare`; only with schedule = paper
    # Whether Gaussians have slopes of luminance (`types.Gaussians`), which are learnt with canonical colours
    # in closed form; only with schedule = paper. An online start always has them.
    slopes: bool = False
    # False: both smoothness losses only count where no frame shows tissue; only with schedule = paper.
    smooth_everywhere: bool = False

    def __post_init__(self) -> None:
        """
        Raises:
            UsageError: the block is an MLP, but its tokens attend to each other; `stable` is no share;
                `coarse` is below 0; `batch_size` is below 1; slopes without a soft loss, which alone has a
                second derivative.
        """
        if self.block == "mlp" and self.tokens != "self":
            raise UsageError(
                f"an MLP in the place of the block has no attention; use tokens self, not {self.tokens}"
            )
        if self.stable is not None and not 0 <= self.stable < 1:
            raise UsageError(f"stable is a share of a stage from 0 to below 1, not {self.stable}")
        if not 0 <= self.coarse < math.inf:
            raise UsageError(f"coarse is at least 0, not {self.coarse}")
        if self.batch_size < 1:
            raise UsageError(f"batch_size is at least 1 frame, not {self.batch_size}")
        if self.slopes and not (self.color_softness > 0 and self.weights.color > 0):
            raise UsageError("slopes need a color_softness and a weights.color above 0, or set slopes=false")

    def of_clip(self, pixels: int, frames: int) -> FitSettings:
        """The settings with a number of Gaussians that suits a clip of `frames` training frames;
        `pixels`: how many pixels show tissue in any of them."""
        if not self.pixels_each:
            return self
        most = min(self.max_gaussians, max(LEAST, math.ceil(pixels / self.pixels_each)))
        if self.schedule == "online":
            most = min(most, room(len(path_frames(frames))))
        return replace(self, max_gaussians=most)

    def rate_share(self, done: int, of: int) -> float:
        """The share of their first values that decaying rates have after `done` of a stage's iterations."""
        if self.stable is None:
            falling: float = self.decay ** (done / (self.decay_over or max(1, of)))
            return falling
        return 1 - (1 - self.decay) * max(0.0, (done / max(1, of) - self.stable) / (1 - self.stable))


ONLINE = FitSettings()
# The paper's schedule, with what is better here: benchmarks/fit.md says by how much.
PAPER = FitSettings(
    schedule="paper",
    tokens="self",
    iterations=3000,
    coarse=0.6,
    shape=FieldShape(frames_per_slot=3.0, most_slots=25),  # each slot needs its share of the iterations
    rates=RowRates(log_scale=1e-2, quat=5e-3, color=5e-3, logit=0.015),
    field_rates=FieldRates(cells=2.5e-2, decoder=5e-4, lines=5e-2),
    decay=0.03,
    stable=0.7,
    growth=Growth(first=None, opacity=0.9, scale=0.6, share=0.15),
    midway=True,
    batch_size=2,
    color_softness=0.15,  # more than most differences
    slopes=True,
)
# The numbers of the authors' code for EndoNeRF (H-Wenfeng/SAGS and EndoGaussian, which it is built on).
# Their SH degree is 3: with one camera that stands still this is a second rate for the same colours, and is
# left out; their colour rate is of an SH coefficient, 0.282 of which is a colour. Their unit is 1 mm.
RELEASED = FitSettings(
    schedule="paper",
    tokens="self",
    iterations=3000,
    max_gaussians=960_000,  # 30,000, doubled five times
    pixels_each=0.0,
    shape=FieldShape(
        levels=4,
        channels=64,
        frames_per_slot=1.26,  # 63 frames on the used half of 100 rows
        first_values=(0.1, 0.5),
        units=Units(mean=1e-3, color=0.0, logit=0.0),
        xavier=True,
    ),
    rates=RowRates(mean_px=0.015, color=7.05e-4, decaying=("means",)),  # 1.6e-3 mm at 60 mm and 569 px
    decay_over=4000,
    growth=Growth(share=1.0),
    weights=LossWeights(),
    smooth_everywhere=True,
)
PRESETS = {"online": ONLINE, "paper": PAPER, "released": RELEASED}
ONLY_PAPER = (
    *("warm_up", "coarse", "rates.quat", "rates.color", "rates.logit", "rates.decaying", "decay_over"),
    *("stable", "growth", "batch_size", "weights", "color_softness", "slopes", "smooth_everywhere"),
)


def iterations_for(frames: int) -> int:
    """The iterations of a fit after an online start that learn a clip of `frames` training frames as well as
    a shorter one."""
    least, most = ITERATIONS
    return min(max(least, ITERATIONS_EACH * frames), most)


def path_frames(frames: int) -> list[int]:
    """The indices of the training frames at whose times the field is told where Gaussians are."""
    return sorted({*range(0, frames, PATH_EVERY), max(0, frames - 1)})


def with_changes(settings: FitSettings, changes: Sequence[str]) -> FitSettings:
    """Return settings with some values changed.

    Args:
        settings: all other values are taken from here.
        changes: each a key, with dots between the names, "=", and a value as in YAML: "shape.levels=4".

    Raises:
        UsageError: there is no such key, or it takes no such value.
    """
    tree: dict[str, Any] = asdict(settings)
    for change in changes:
        key, given, value = change.partition("=")
        *path, last = key.split(".")
        branch: Any = tree
        for name in path:
            branch = branch.get(name) if isinstance(branch, dict) else None
        if not given or not isinstance(branch, dict) or isinstance(branch.get(last, {}), dict):
            raise UsageError(
                f"--set {change}: give KEY=VALUE with one of these keys: {', '.join(_keys(tree))}"
            )
        branch[last] = parse_word(value, f"--set {change}")
    try:
        return TypeAdapter(FitSettings).validate_python(tree)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise UsageError(f"--set {key}: {first['msg'].lower()}, not {first['input']!r}") from None


def check_used(settings: FitSettings, preset: FitSettings) -> None:
    """Check that every value that differs from the preset's has an effect.

    Raises:
        UsageError: one has none.
    """
    online, stable, slopes = settings.schedule == "online", settings.stable is not None, settings.slopes
    idle = {
        "after an online start; give --schedule paper": ONLY_PAPER if online else (),
        "beside stable; set stable=null": ("decay_over",) if stable else (),
        "beside slopes; set slopes=false": ("rates.color",) if slopes else (),
    }
    for why, keys in idle.items():
        if set_in_vain := [key for key in keys if attrgetter(key)(settings) != attrgetter(key)(preset)]:
            raise UsageError(f"{', '.join(set_in_vain)} would change nothing {why}, or leave it out")


def _keys(tree: dict[str, Any], before: str = "") -> list[str]:
    """All keys that `with_changes` takes."""
    found = []
    for name, value in tree.items():
        found += _keys(value, f"{before}{name}.") if isinstance(value, dict) else [before + name]
    return found
