"""`sags register`: place a preoperative model on the tissue, and say how exactly."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from sags_node.cli.launching import (
    as_json,
    check_apart,
    check_files,
    file_option,
    force_option,
    positive,
    shown,
)
from sags_node.cli.node_options import data_options, run_dir_option
from sags_node.errors import SagsError
from sags_node.files import whole
from sags_node.terminal.console import show

if TYPE_CHECKING:
    from sags_node.messaging.address import NodeAddress


@click.command()
@click.argument("model", metavar="MODEL.ply|stl|obj", type=click.Path(path_type=Path, dir_okay=False))
@file_option("--points", required=True, metavar="PAIRS.yaml", help="3 to 20 pairs of points, as shown above.")
@file_option("-o", "--out", required=True, metavar="SCENE.yaml", help="Scene file for sags overlay.")
@shown("--scale", type=positive, default=0.001, help="Metres per unit of MODEL; files of scans are in mm.")
@shown("--seconds", type=positive, default=1.0, help="How long the surface is looked at.")
@data_options
@run_dir_option
@force_option
@as_json
def register(
    model: Path,
    points: Path,
    out: Path,
    scale: float,
    seconds: float,
    node: NodeAddress,
    force: bool,
    json_out: bool,
) -> None:
    """Place a model on the tissue, and say how exactly.

    First it is laid on the pairs of points, then its side that faces the camera on the surface that the node
    measures. Both errors are told, and a verdict: good, doubtful or refused, with the remedy. What is
    refused is not written (exit code 1).

    \b
    cat > pairs.yaml <<END
    pairs:                                       # `at` is in the file's units
      - {pixel: [230, 180], at: [-11.2, 0.4, 3.0]}   # of left/image_rect_color
      - {pixel: [412, 201], at: [24.8, -3.1, 5.2]}
      - {pixel: [318, 340], at: [6.0, 31.5, -2.2]}
      - {anchor: 2, at: [9.1, 12.4, 8.8]}            # sags anchor pin U V
    targets: [[5, 10, 25]]                       # their errors are told
    END
    sags register liver.stl --points pairs.yaml -o scene.yaml
    sags overlay --scene scene.yaml

    docs/overlay.md says what the figures mean.
    """
    import yaml

    from sags_node.clients.overlay.registering import register_live
    from sags_node.clients.overlay.scene import read_pairs

    check_apart((out,), (model, points))
    check_files(out, force=force)
    said, scene = register_live(model, scale, read_pairs(points), node, seconds, out)
    if json_out:
        show(said | {"scene": None if scene is None else str(out)})
    else:
        show(yaml.safe_dump(said, sort_keys=False).rstrip())
    if scene is None:
        raise SagsError(f"refused: {said['reason']}")
    with whole(out) as partial:
        content = yaml.safe_dump(scene, sort_keys=False, default_flow_style=None)
        partial.write_text(content, encoding="utf-8")
