"""What is said of a network: in the file itself, in a YAML file beside it, in the launch file. Later wins."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sags_node.config.schema import NetworkFormat, OnnxConfig
from sags_node.config.yaml_reader import parse_yaml, read_yaml
from sags_node.errors import UsageError

LARGEST_SIDECAR = 2**16  # bytes
KEYS = tuple(NetworkFormat.model_fields)


def read_format(config: OnnxConfig, metadata: Mapping[str, str]) -> NetworkFormat:
    """All that is said of the network.

    Args:
        metadata: of the ONNX file, each value as YAML; keys that `NetworkFormat` lacks are others'.

    Raises:
        UsageError: a value is wrong, or the sidecar cannot be read or holds an unknown key.
    """
    assert config.path is not None
    sidecar = config.path.with_suffix(".yaml")
    found = _validated({key: metadata[key] for key in KEYS if key in metadata}, f"metadata of {config.path}")
    if sidecar.is_file():
        found |= _validated(_read_sidecar(sidecar), str(sidecar))
    said = {key: getattr(config, key) for key in KEYS if getattr(config, key) is not None}
    return NetworkFormat(**(found | said))


def _read_sidecar(file: Path) -> dict[str, Any]:
    tree = read_yaml(file, "description of a network", LARGEST_SIDECAR)
    if not isinstance(tree, dict):
        raise UsageError(f"{file}: a map of keys is expected: {', '.join(KEYS)}")
    return tree


def _validated(tree: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The values of a map that are said, typed; text is read as YAML, since metadata holds only text."""
    try:
        parsed = {
            key: parse_yaml(value, f"{where}: {key}") if isinstance(value, str) else value
            for key, value in tree.items()
        }
        checked = NetworkFormat.model_validate(parsed)
    except ValidationError as error:
        item = error.errors()[0]
        key = str(item["loc"][0]) if item["loc"] else "format"
        reason = f"known keys: {', '.join(KEYS)}" if item["type"] == "extra_forbidden" else item["msg"]
        raise UsageError(f"{where}: {key}: {reason}") from None
    return {key: getattr(checked, key) for key in KEYS if getattr(checked, key) is not None}
