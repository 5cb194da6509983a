"""D4D measured: depth at a clip's first and last frame against the scan before and after it."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sags_lab.protocols.arithmetic import depth_figures
from sags_lab.protocols.d4d_files import D4dClip, Scan, d4d_clips, instruments_are_white, read_tools
from sags_lab.protocols.d4d_population import in_population
from sags_lab.protocols.d4d_scan import check_scan, read_surface, scan_depth
from sags_lab.protocols.playing import AS_GIVEN, Progress, configured, stride_of
from sags_node.config.schema import LaunchConfig
from sags_node.errors import SagsError
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_posed
from sags_node.quality import metrics
from sags_node.sources.pictures import list_pictures
from sags_node.sources.truth import load_npy
from sags_node.types import F32, Bool, FrameResult

Figures = dict[str, Any]  # numbers, in groups
WHEN = ("start", "end")  # of a clip's scans
REGIONS = ("visible", "occluded")


def measure_d4d(folder: Path, overrides: Sequence[str], progress: Progress) -> dict[str, Any]:
    """Measure each clip: depth at its first frame against the scan before it, at its last against the one
    after it. Measured are stereo (`measured`), the drawn model and the data set's own stereo, where the left
    eye sees tissue (`visible`), and where it sees an instrument but the scan tissue (`occluded`). PSNR over
    tissue is that of the drawn model, and of the frame before in its place. All figures are means over clips;
    `population` has those of depth over the public population, in which no scan is refused.

    Raises:
        SagsError: every scan disagrees with stereo, or a file is wrong. A single scan that does is `refused`,
            says why, and counts in the population only.
    """
    clips = {clip.name: _measure_clip(clip, overrides, progress) for clip in d4d_clips(folder)}
    scans = [(name, when) for name, clip in clips.items() for when in WHEN if when in clip]
    refused = [found["refused"] for name, when in scans if "refused" in (found := clips[name][when])]
    if len(refused) == len(scans):
        raise SagsError(refused[0] if refused else f"{folder}: no frame that belongs to a scan was played")
    counts = {"clips": len(clips), "scans": len(scans) - len(refused), "refused": len(refused)}
    ours = [
        {**clip, **{when: {} for when in WHEN if "refused" in clip.get(when, {})}} for clip in clips.values()
    ]
    kept = [(when, clips[name][when]) for name, when in scans if in_population(name, when)]
    theirs = [{when: {key: found[key] for key in REGIONS if key in found}} for when, found in kept]
    population = {"scans": len(kept), "left_out": len(scans) - len(kept), **_mean(theirs)}
    return {**counts, **_mean(ours), "population": population, "of_each": clips}


def _measure_clip(clip: D4dClip, overrides: Sequence[str], progress: Progress) -> Figures:
    white = instruments_are_white(list(clip.masks.values()))
    given = ["source.kind:=folders", f"source.left:={clip.left}", f"source.right:={clip.right}"]
    pose = ["vision.pose:=estimate"] if clip.is_moved else []
    config = configured([*given, f"source.rate:={clip.rate}", AS_GIVEN, *pose], overrides)
    run = _Run(clip, config)
    with open_posed(config, clip.rig, references=False) as frames:
        for frame in frames:
            file = clip.masks.get(number := run.number_of(frame.frame_id))
            tools = None if file is None or white is None else read_tools(file, white)
            tissue = None if tools is None else ~tools
            result = run.pipeline.process(replace(frame, tissue=tissue), run.budget)
            run.look(number, result, tools)
            progress(number + 1, clip.name)
    masks = "none" if white is None else f"{'white' if white else 'black'} is instrument"
    return {"moved": clip.is_moved, "masks": masks, **run.figures()}


class _Run:
    """One clip, played."""

    def __init__(self, clip: D4dClip, config: LaunchConfig) -> None:
        self._clip = clip
        self._stride = stride_of(config)
        self._last = len(list_pictures(clip.left)) - 1
        self.pipeline = Pipeline(config, clip.rig)
        self.budget = self.pipeline.make_budget()
        self._scans = {scan.when: scan for scan in clip.scans}
        self._found: Figures = {}
        self._drawn: list[float] = []
        self._copied: list[float] = []
        self._before: F32 | None = None

    def number_of(self, frame_id: int) -> int:
        """The number of a frame among all images of the clip."""
        return frame_id * self._stride

    def look(self, number: int, result: FrameResult, tools: Bool | None) -> None:
        """Compare the drawn frame with its image, and depth with the scan that belongs to the frame."""
        tissue, image = result.observation.tissue, metrics.as_float(result.observation.image)
        self._drawn.append(metrics.psnr(metrics.as_float(result.views["left"].rgb), image, tissue))
        if self._before is not None:
            self._copied.append(metrics.psnr(self._before, image, tissue))
        self._before = image
        if number == 0 and "start" in self._scans:
            self._found["start"] = self._compared(self._scans["start"], number, result, tools)
        if number > self._last - self._stride and "end" in self._scans:
            self._found["end"] = self._compared(self._scans["end"], number, result, tools)

    def _compared(self, scan: Scan, number: int, result: FrameResult, tools: Bool | None) -> Figures:
        seen = result.observation
        points, is_tissue = read_surface(scan)
        try:
            checked: Figures = {"agrees_with_stereo": check_scan(scan, points, seen.camera, seen.depth)}
        except SagsError as error:
            checked = {"refused": str(error)}
        tissue = points if is_tissue is None else points[is_tissue]
        truth = scan_depth(tissue, scan.T_cloud_cam, seen.camera)
        said = {"measured": seen.depth, "model": result.views["left"].depth}
        if (theirs := self._data_sets(number, seen.depth.shape)) is not None:
            said["data_set_stereo"] = theirs
        regions = {"visible": seen.tissue}
        if tools is not None and is_tissue is not None:
            height, width = seen.tissue.shape
            hidden = metrics.resample_nearest(tools.astype(np.float32), width, height) > 0
            regions["occluded"] = hidden
        return {
            **checked,
            "scan_coverage": float(np.mean(truth > 0)),
            **{
                region: {
                    what: figures
                    for what, depth in said.items()
                    if (figures := depth_figures(depth, truth, where)) is not None
                }
                for region, where in regions.items()
            },
        }

    def _data_sets(self, number: int, shape: tuple[int, ...]) -> F32 | None:
        """Depth [H, W] m by the data set's own stereo, at the working size; None: it has none."""
        if not self._clip.stereo:
            return None
        rig = self._clip.rig
        size = rig.left.height, rig.left.width
        depth = load_npy(self._clip.stereo[number], size).astype(np.float32)
        known: F32 = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
        return metrics.resample_nearest(known, shape[1], shape[0])

    def figures(self) -> Figures:
        psnr = {"drawn": _average(self._drawn), "frame_before": _average(self._copied)}
        return {"frames": len(self._drawn), **self._found, "psnr": psnr}


def _average(values: Sequence[float]) -> float | None:
    """Mean of the finite values: the PSNR of an image without tissue is not finite."""
    numbers = [value for value in values if math.isfinite(value)]
    return float(np.mean(numbers)) if numbers else None


def _mean(rows: Sequence[Figures]) -> Figures:
    """Mean of each number over the rows that have it; groups stay groups."""
    found: Figures = {}
    for key in dict.fromkeys(key for row in rows for key in row):
        values = [row[key] for row in rows if row.get(key) is not None]
        if values and isinstance(values[0], dict):
            found[key] = _mean(values)
        elif values and isinstance(values[0], float):
            found[key] = float(np.mean(values))
    return found
