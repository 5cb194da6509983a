"""A name for everything that the machine code of a kernel depends on.

Numba's own disk cache looks at the file a kernel stands in and at nothing which that file imports: after an
edit of a helper or of a constant elsewhere, the caller's old machine code would go on running. The name made
here changes with

- the file that a kernel stands in and every file of this package which that one names, directly or through
  others;
- the versions of Python, Numba and llvmlite;
- the compile target: CPU, its features, and Numba's settings.

Sources are searched as text: any mention of a module by its full name counts as an import, and that of a
folder as an import of all its modules whose names occur in the text. So no import is missed, and an edit
changes the names of the files that depend on it and of few others.
"""

import functools
import hashlib
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba.core.registry import cpu_target

_PACKAGE = Path(__file__).parents[1]
_MENTION = re.compile(rf"\b{_PACKAGE.name}((?:\.\w+)*)")
_WORD = re.compile(r"\w+")
_STARTED = time.time()
# Settings of Numba that do not change machine code. All others are part of the digest.
_HARMLESS = {
    *("CACHE_DIR", "CACHE_LOCATOR_CLASSES", "DEBUG_CACHE", "COLOR_SCHEME", "CHROME_TRACE"),
    *("NUMBA_NUM_THREADS", "NUMBA_DEFAULT_NUM_THREADS", "THREADING_LAYER", "THREADING_LAYER_PRIORITY"),
}


def kernel_name(function: Callable[..., Any]) -> str | None:
    """Return module and digest, as in `engine.rasterizer.binning-31b9...`, shared by a file's kernels.

    None: the function's dependencies are not known. It is outside the package (in a test, say), or it is a
    closure over other functions; or a source changed while this process ran, which may still run the former
    text.
    """
    if any(callable(cell.cell_contents) for cell in function.__closure__ or ()):
        return None
    return _name(function.__code__.co_filename)


@functools.cache
def _name(file: str) -> str | None:
    if not Path(file).is_relative_to(_PACKAGE):
        return None
    digests: dict[Path, bytes] = {}
    waiting = [Path(file)]
    while waiting:
        path = waiting.pop()
        if path in digests:
            continue
        source = _read(path)
        if source is None:
            return None
        digests[path], named = source
        waiting += named
    digest = hashlib.sha256(_surroundings())
    for path in sorted(digests):
        digest.update(f"\n{path.relative_to(_PACKAGE)} ".encode() + digests[path])
    module = ".".join(Path(file).relative_to(_PACKAGE).with_suffix("").parts)
    return f"{module}-{digest.hexdigest()[:24]}"


@functools.cache
def _read(path: Path) -> tuple[bytes, set[Path]] | None:
    """Digest of a source file, and the files of the package that it names."""
    try:
        changed, source = path.stat().st_ctime, path.read_bytes()
    except OSError:
        return None
    if _STARTED < changed <= time.time():
        return None
    text = source.decode()
    words = {*_WORD.findall(text), "__init__"}
    named = {file for name in set(_MENTION.findall(text)) for file in _files(name) if file.stem in words}
    return hashlib.sha256(source).digest(), named


@functools.cache
def _files(name: str) -> set[Path]:
    """The files that a dotted name within the package may refer to; its last parts may be names in a file."""
    place = _PACKAGE
    for part in name.split(".")[1:]:
        place /= part
        if (file := place.with_name(f"{part}.py")).is_file():
            return {file}
        if not place.is_dir():
            return {place.with_name("__init__.py")}
    return {*place.glob("*.py"), *place.glob("*/__init__.py")}


@functools.cache
def _surroundings() -> bytes:
    """Everything that machine code depends on besides the sources."""
    config = vars(numba.config)
    settings = sorted((key, str(config[key])) for key in config if key.isupper() and key not in _HARMLESS)
    target = cpu_target.target_context.codegen().magic_tuple()
    return repr((sys.version, numba.__version__, llvmlite.__version__, target, settings)).encode()
