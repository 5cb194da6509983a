"""Imports point down only, so that every part can be read, replaced and tested alone."""

import ast
from pathlib import Path

ROOT = Path(__file__).parent.parent / "sags_node"
LAYERS = [
    {"errors", "types", "latest", "processes", "native_output", "kernels"},
    {"files", "findings", "geometry", "confidence", "config", "picture_file"},
    {"yaml_reader"},
    {"launch_file"},
    {"calibration"},
    {"phantom"},
    {"vision", "engine", "messaging", "disturbances"},
    {"recording", "client"},
    {"sources"},
    {"model"},
    {"mapping"},
    {"pipeline"},
    {"session", "warm_up", "views", "health"},
    {"node"},
    {"evaluation"},
    {"fitting"},
    {"benchmark"},
    {"apps", "viewer"},
    {"cli_bench_depth", "cli_bench_disturbances", "cli_bench_masks", "cli_bench_node"},
    {"cli_bench", "cli_calib", "cli_consumers", "cli_offline"},
    {"cli_bag", "cli_export", "cli_view"},
    {"cli"},
]
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}


def imported_parts(file: Path) -> set[str]:
    """First-level parts of sags_node that a file imports."""
    parts = set()
    for node in ast.walk(ast.parse(file.read_text())):
        modules = []
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules = [node.module]
            if node.module == "sags_node":
                modules = [f"sags_node.{alias.name}" for alias in node.names if alias.name in LEVEL]
        parts |= {m.split(".")[1] for m in modules if m.startswith("sags_node.")}
    return parts


def test_imports_point_down() -> None:
    wrong = []
    for file in ROOT.rglob("*.py"):
        part = file.relative_to(ROOT).parts[0].removesuffix(".py")
        if part in {"__init__", "__main__"}:
            continue
        for other in imported_parts(file) - {part}:
            if LEVEL[other] >= LEVEL[part]:
                wrong.append(f"{file.relative_to(ROOT)} imports {other}")
    assert not wrong, wrong
