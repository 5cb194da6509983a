"""Where the repository's own files lie."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
HELPERS = ROOT / "tests/helpers"
SESSION = ROOT / "replay/phantom_pull"  # forty frames of the phantom
