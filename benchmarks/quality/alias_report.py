"""The alias table for people, and the picture that shows what it means."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import cv2
import numpy as np
from rich.table import Table

from benchmarks.quality.alias import VARIANTS, Trained
from benchmarks.quality.alias_truth import AliasTruth
from sags_node.types import F32, U8

CROPS = {0.25: (0.45, 0.45, 0.4), 4.0: (0.62, 0.6, 0.1)}  # size -> left, top, side: shares of the picture
PANEL = (400, 320)  # px


def tables(measured: Mapping[str, Any]) -> Iterator[Table]:
    """`measured` as `measure_alias` returns it."""
    yield _by_factor("PSNR, dB, at a picture size of", measured["psnr_at_size"], "{:.2f}")
    yield _by_factor("PSNR, dB, from a distance of", measured["psnr_at_distance"], "{:.2f}")
    changes = measured["thin_vessel_brightness_change"]
    yield _by_factor("brightness of thin vessels, at a picture size of", changes, "{:+.2%}")
    flicker = measured["flicker"]
    for part in ("picture", "error"):
        row = {"factor": flicker["size"]} | {name: flicker[name][part] for name in VARIANTS}
        yield _by_factor(f"flicker of the {part} against the truth's, at a size of", [row], "{:.2f}")
    joined = Table("view from nearer by", "PSNR, dB", "its camera in the 3D filter")
    for row in measured["requested_view_in_filter"]:
        joined.add_row(row["view"], f"{row['no']:.2f}", f"{row['yes']:.2f}")
    yield joined


def _by_factor(title: str, rows: list[dict[str, Any]], shown: str) -> Table:
    made = Table(title, *(name.replace("_", " ") for name in VARIANTS))
    for row in rows:
        made.add_row(f"x {row['factor']:g}", *(shown.format(row[name]) for name in VARIANTS))
    return made


def picture(truth: AliasTruth, models: Mapping[str, Trained]) -> bytes:
    """Pieces of tissue at a quarter and at four times the trained size, as PNG: truth, both filters, none."""
    rows = []
    for factor, crop in CROPS.items():
        shot = truth.at_size(factor)
        drawn = {"both filters": models["both"], "no filter": models["none"]}
        images = {"truth": shot.image} | {name: model.draw(shot.camera) for name, model in drawn.items()}
        rows.append(
            np.hstack([_panel(image, crop, f"{name}, x {factor:g}") for name, image in images.items()])
        )
    return cv2.imencode(".png", np.vstack(rows)[..., ::-1])[1].tobytes()


def _panel(image: F32, crop: tuple[float, float, float], title: str) -> U8:
    """`crop`: left, top and side as shares of the picture."""
    height, width = image.shape[:2]
    left, top = round(crop[0] * width), round(crop[1] * height)
    piece = image[top : top + round(crop[2] * height), left : left + round(crop[2] * width)]
    levels = np.asarray(np.clip(piece * 255 + 0.5, 0, 255), np.uint8)
    panel = cv2.resize(levels, PANEL, interpolation=cv2.INTER_NEAREST)
    framed = cv2.copyMakeBorder(panel, 28, 4, 4, 4, cv2.BORDER_CONSTANT, value=(255, 255, 255))
    cv2.putText(framed, title, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 1, cv2.LINE_AA)
    return np.asarray(framed, np.uint8)
