"""The settings of the online mapper that are compared: each a few overrides of a launch file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

from sags_node.config.schema import LaunchConfig
from sags_node.errors import UsageError
from sags_node.mapping.devices import ALL_SKIPS, Skips
from sags_node.mapping.ladder import RUNGS
from sags_node.tools.evaluation.measure import MeasureOptions

PARTS = ("budgets", "resolutions", "gaussians", "skips")
# Parts that run only on request: each rung of the ladder, one step a frame; and live on weaker hosts.
RUNG_PART, HOSTS = "rungs", "hosts"
BUDGETS_MS = (25.0, 33.0, 50.0, 100.0, 200.0)
SIZES = (0.75, 0.5)  # of the launch file's working size
COUNTS = (10_000, 20_000, 30_000, 50_000, 70_000)
COUNT_BUDGETS_MS = (33.0, 100.0)
SKIP_STEPS = 2  # per frame, where rules that leave work out are compared
HURRIED_RULES = ("depth",)  # rules that act on rungs of the ladder for when time is short

BUDGET, COUNT = "mapping.budget_ms", "mapping.max_gaussians"
WIDTH, HEIGHT = "vision.width", "vision.height"

DEFAULT_OPTIONS = MeasureOptions()


@dataclass(frozen=True, slots=True)
class Setting:
    """One way to run a recording."""

    part: str  # of PARTS, or "default"
    name: str
    overrides: tuple[str, ...]  # key:=value, on top of the launch file; none: the default
    skips: Skips = ALL_SKIPS


@dataclass(frozen=True, slots=True)
class Sweep:
    """What to compare.

    Raises:
        UsageError: an unknown part.
    """

    parts: tuple[str, ...] = PARTS
    repeat: int = 1
    options: MeasureOptions = DEFAULT_OPTIONS

    def __post_init__(self) -> None:
        known = (*PARTS, RUNG_PART, HOSTS)
        unknown = [part for part in self.parts if part not in known]
        if unknown or not self.parts:
            raise UsageError(f"unknown part '{', '.join(unknown)}'; choose from {', '.join(known)}")


def time_settings(config: LaunchConfig, size: tuple[int, int], parts: Sequence[str]) -> list[Setting]:
    """Return the settings with a time budget, each once, the default (the launch file as it is) first.

    `size`: the default's working size, width and height, px.
    """
    default = {BUDGET: config.mapping.frame_ms(), WIDTH: size[0], HEIGHT: size[1]}
    if config.mapping.max_gaussians is not None:
        default[COUNT] = config.mapping.max_gaussians
    asked: list[tuple[str, Mapping[str, float]]] = [("default", {})]
    if "budgets" in parts:
        asked += [("budgets", {BUDGET: ms}) for ms in BUDGETS_MS]
    if "resolutions" in parts:
        shrunk = [(round(size[0] * share), round(size[1] * share)) for share in SIZES]
        asked += [("resolutions", {WIDTH: width, HEIGHT: height}) for width, height in shrunk]
    if "gaussians" in parts:
        asked += [("gaussians", {BUDGET: ms, COUNT: count}) for ms in COUNT_BUDGETS_MS for count in COUNTS]
    settings: dict[tuple[str, ...], Setting] = {}
    for part, values in asked:
        overrides = tuple(f"{key}:={value}" for key, value in values.items() if value != default.get(key))
        settings.setdefault(overrides, Setting(part, _name({**default, **values}), overrides))
    return list(settings.values())


def rung_settings() -> list[Setting]:
    """Return a setting for each rung of the ladder, one step a frame."""
    step = "mapping.iterations:=1"
    return [Setting(RUNG_PART, f"rung {i}", (step, f"mapping.rung:={i}")) for i in range(len(RUNGS))]


def skip_settings() -> dict[str, tuple[Setting, Setting]]:
    """Return, for each rule of `Skips`, two settings: all rules, and all but this one.

    Both at a fixed number of steps. A rule for when time is short is compared on the highest rung of the
    ladder on which it acts.
    """
    steps = Setting("skips", "all rules", (f"mapping.iterations:={SKIP_STEPS}",))
    rung = max(i for i, each in enumerate(RUNGS) if each.depth_every > 1)
    hurry = Setting("skips", "in a hurry", ("mapping.iterations:=1", f"mapping.rung:={rung}"))
    pairs = {}
    for rule in (field.name for field in fields(Skips)):
        base = hurry if rule in HURRIED_RULES else steps
        off = replace(ALL_SKIPS, **{rule: False})
        pairs[f"skip_{rule}"] = base, replace(base, name=f"{base.name} but skip_{rule}", skips=off)
    return pairs


def _name(values: Mapping[str, float]) -> str:
    """A setting's name. If it has no number of Gaussians, that number follows from the budget."""
    count = f", {values[COUNT] / 1e3:g}k" if COUNT in values else ""
    return f"{values[BUDGET]:g} ms, {values[WIDTH]}x{values[HEIGHT]}{count}"
