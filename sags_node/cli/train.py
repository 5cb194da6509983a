"""`sags train`: networks of one's own."""

from __future__ import annotations

from pathlib import Path

import click
from rich.markup import escape

from sags_node.errors import SagsError
from sags_node.files import check_file, whole
from sags_node.terminal.console import console, progress

HELD_OUT_BATCHES = 16
MOST_DIFFERENCE = 1e-3  # px: sums are taken in another order


@click.group()
def train() -> None:
    """Train a network of one's own, and write it as ONNX."""


@train.command("depth")
@click.option(
    *("-o", "--out"),
    type=click.Path(path_type=Path, dir_okay=False),
    required=True,
    metavar="FILE.onnx",
    help="The network; FILE.pt beside it is the state of the training, which goes on from there.",
)
@click.option(
    "--steps",
    type=click.IntRange(1),
    default=8000,
    show_default=True,
    help="Of training, four pairs each.",
)
@click.option(
    "--tissues",
    type=click.IntRange(1, 1000),
    default=8,
    show_default=True,
    help="Phantoms to render, six pairs of each.",
)
@click.option(
    "--textures",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    help="Pictures of real tissue, one eye's, to paint further pairs with.",
)
@click.option(
    "--seed", type=click.IntRange(0), default=0, show_default=True, help="Another one, other pairs."
)
def train_depth(out: Path, steps: int, tissues: int, textures: Path | None, seed: int) -> None:
    """Train a small stereo network on pairs whose disparity is known.

    Pairs are crops of rendered phantoms, and surfaces painted with single pictures, one before the other; all
    with the faults of cameras. No depth of a recording is needed, nor used. The file is run by
    vision.onnx.path, and compared with the matchers by sags bench depth --network.

    Ctrl-C ends it; the same command goes on. Once --steps are done, the file is written.

    \b
    sags train depth --out stereo.onnx --textures pictures/of/my/scope
    sags run launch/d4d_pull.yaml vision.onnx.path:=stereo.onnx
    sags bench depth launch/d4d_pull.yaml --network stereo.onnx
    """
    from sags_node.learning.material import gather
    from sags_node.learning.onnx_file import check_export, difference, export
    from sags_node.learning.training import Trainer, errors

    check_export()
    state = out.with_suffix(".pt")
    check_file(out, force=state.is_file())
    with progress("rendering") as advance:
        material = gather(tissues, textures, seed, advance)
    trainer = Trainer(material, steps, seed)
    if state.is_file():
        trainer.resume(state)
        console.print(f"goes on from step {trainer.step}, as {escape(str(state))} says", soft_wrap=True)
    with progress("training") as advance:
        trainer.train(advance, state)
    median, p90 = errors(trainer.network, material, HELD_OUT_BATCHES)
    trained = (
        f"{trainer.step} steps on {len(material.rendered)} rendered pairs, {len(material.textures)} textures"
    )
    with whole(out) as partial:
        export(trainer.network, partial, trained)
    off = difference(trainer.network, out)
    if off > MOST_DIFFERENCE:
        raise SagsError(f"{out} gives other numbers in ONNX Runtime than in torch, by {off:.2g} px")
    console.print(
        f"{escape(str(out))}: off by {median:.2f} px (median), {p90:.2f} px (p90) on pairs of other draws",
        soft_wrap=True,
    )
