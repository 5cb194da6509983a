"""A name for everything that the machine code of a kernel depends on.

Numba's own disk cache looks at the file a kernel stands in and at nothing which that file imports: after an
edit of a helper or of a constant elsewhere, the caller's old machine code would go on running. The name made
here changes with

- the file that a kernel stands in and every file of this package which that one names, directly or through
  others;
- the versions of Python, Numba and llvmlite;
- the compile target: CPU, its features, and Numba's settings.

What is read is text, not syntax: any mention of a module by its full name counts as an import. So nothing is
missed, and an edit changes the names of the files that stand on it and of no others.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba.core.registry import cpu_target

_PACKAGE = os.path.dirname(os.path.dirname(__file__))
_MENTION = re.compile(rf"\b{os.path.basename(_PACKAGE)}(?:\.\w+)*".encode())
_WORD = re.compile(rb"\w+")
_STARTED = time.time()
# These settings of Numba do not change machine code. Whatever is not listed counts.
_HARMLESS = {
    *("CACHE_DIR", "CACHE_LOCATOR_CLASSES", "DEBUG_CACHE", "COLOR_SCHEME", "CHROME_TRACE"),
    *("NUMBA_NUM_THREADS", "NUMBA_DEFAULT_NUM_THREADS", "THREADING_LAYER", "THREADING_LAYER_PRIORITY"),
}


def kernel_name(function: Callable[..., Any]) -> str | None:
    """Module and digest, as in `engine.rasterizer.binning-31b9...`, shared by the kernels of one file.

    None: what the function stands on is not known. It stands outside the package (in a test, say), or it was
    made around functions that were handed to its maker; or a source changed while this process ran, which
    may still run the former text.
    """
    if any(callable(cell.cell_contents) for cell in function.__closure__ or ()):
        return None
    return _name(function.__code__.co_filename)


@functools.cache
def _name(file: str) -> str | None:
    digests: dict[str, bytes] = {}
    waiting = [file]
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
        digest.update(f"\n{_inside(path)} ".encode() + digests[path])
    return f"{_inside(file).removesuffix('.py').replace(os.sep, '.')}-{digest.hexdigest()[:24]}"


def _inside(path: str) -> str:
    return path.removeprefix(_PACKAGE + os.sep)


@functools.cache
def _read(path: str) -> tuple[bytes, set[str]] | None:
    """Digest of a source file, and the files of the package that it names."""
    try:
        changed = os.stat(path).st_ctime
        source = Path(path).read_bytes()
    except OSError:
        return None
    if _inside(path) == path or _STARTED < changed <= time.time():
        return None
    named: set[str] = set()
    for name in set(_MENTION.findall(source)):
        found, modules = _find(name.decode())
        named.add(found)
        if modules and re.search(rb"from\s+%s\s+import\b" % re.escape(name), source):
            named |= {modules[word] for word in _WORD.findall(source) if word in modules}
    return hashlib.sha256(source).digest(), named


@functools.cache
def _find(name: str) -> tuple[str, dict[bytes, str]]:
    """The file that a dotted name leads to; the rest of the name is something in it. Where that is a package,
    also the files of its modules by their names: `from package import module`."""
    place = _PACKAGE
    for part in name.split(".")[1:]:
        if os.path.isfile(f"{place}/{part}.py"):
            return f"{place}/{part}.py", {}
        if not os.path.isfile(f"{place}/{part}/__init__.py"):
            break
        place = f"{place}/{part}"
    modules = {}
    for entry in os.listdir(place):
        path = f"{place}/{entry}" if entry.endswith(".py") else f"{place}/{entry}/__init__.py"
        if os.path.isfile(path):
            modules[entry.removesuffix(".py").encode()] = path
    return modules.pop(b"__init__"), modules


@functools.cache
def _surroundings() -> bytes:
    """Everything beside the sources that machine code depends on."""
    config = vars(numba.config)
    settings = sorted((key, str(config[key])) for key in config if key.isupper() and key not in _HARMLESS)
    target = cpu_target.target_context.codegen().magic_tuple()
    return repr((sys.version, numba.__version__, llvmlite.__version__, target, settings)).encode()
