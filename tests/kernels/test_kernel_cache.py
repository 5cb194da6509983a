"""Compiled kernels on disk: never stale, never mixed, never in the way."""

import json
import os
import re
import shutil
from pathlib import Path

import numba
import pytest
from forked import Forked, Said

from sags_node.engine.pinhole import to_pixel
from sags_node.kernels import cache, digest
from sags_node.kernels.cache import cache_root
from sags_node.kernels.jit import kernel

PACKAGE = Path(digest.__file__).parents[1]
# A constant that comes through two files, a helper through one, and a kernel made around a function.
MADE = {
    "__init__": "",
    "deep": "FACTOR = 2.0",
    "constants": "from sags_node.made import deep\nSCALE = deep.FACTOR",
    "names": "from sags_node.made.helper import helper",
    "maker": """
from sags_node.kernels.jit import kernel
def make(helper):
    @kernel
    def made(x):
        return helper(x)
    return made
""",
    "helper": """
from sags_node.kernels.jit import inlined
@inlined
def helper(x):
    return x + 1.0
""",
    "caller": """
from sags_node.kernels.jit import kernel
from sags_node.made import maker, names
from sags_node.made.constants import SCALE
helped = names.helper
made = maker.make(helped)
@kernel
def scaled(x):
    return SCALE * helped(x)
""",
}
CALLED = """
import json
from sags_node.made import caller
intervals = [caller.scaled(9.0), caller.made(9.0)]
used = [caller.made, caller.scaled]
"""
COMPILED, LOADED = [2, 0], [1, 1]  # of `CALLED`: one of the two is never kept
COUNTED = """
found = [sum(sum(counted.values()) for counted in
             (getattr(kernel.stats, name) for kernel in used)) for name in ("cache_misses", "cache_hits")]
print(json.dumps([*map(float, intervals), *found]))
"""


# A kernel whose helper rounds otherwise by itself than where it is linked in; what other kernels see of it.
LOSS = """
import hashlib, json, numpy as np
from llvmlite.binding import Linkage
from sags_node.engine.losses import tissue
random = np.random.default_rng(0)
planes, depth = (random.random(shape, np.float32) for shape in ((5, 64, 80), (64, 80)))
image = random.integers(0, 256, (64, 80, 3), np.uint8)
slopes, weight = np.empty_like(planes), np.empty_like(depth)
tissue.tissue_loss(planes, image, depth > 0.1, depth, slopes, weight, 2e-3, 1e-3)
used = [one for one in vars(tissue).values() if getattr(one, "targetoptions", {}).get("parallel")]
(kernel,) = used[0].overloads.values()
shared = [f for f in kernel.library.get_defined_functions() if f.linkage == Linkage.linkonce_odr]
intervals = [int(hashlib.sha256(slopes).hexdigest()[:12], 16), len(shared)]
"""


@pytest.fixture(scope="module")
def whole_copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    copy = tmp_path_factory.mktemp("copy")
    shutil.copytree(PACKAGE, copy / "sags_node", ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "sags_node/made").mkdir()
    for name, text in MADE.items():
        (copy / f"sags_node/made/{name}.py").write_text(text)
    return copy


def start(copy: Path, code: str, cache: Path | None = None, **environment: str) -> Forked:
    """Kernels are kept in `cache`, or beside the copy."""
    return Forked(copy, code, NUMBA_CACHE_DIR=str(cache or copy / "cache"), **environment)


def numbers(said: Said) -> list[float]:
    """What code that ends with `COUNTED` found, then the numbers of kernels compiled and loaded."""
    assert said.stdout, said.stderr
    found: list[float] = json.loads(said.stdout)
    return found


def run(copy: Path, code: str, **environment: str) -> list[float]:
    """The numbers of a process of its own."""
    return numbers(start(copy, code + COUNTED, **environment).said())


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert text.count(old) == 1
    file.write_text(text.replace(old, new))


# ---- never stale -------------------------------------------------------------------------------------------


def test_constants_and_helpers_are_followed_through_any_number_of_files(whole_copy: Path) -> None:
    """A kernel made around a function is never kept, because that function may come from anywhere."""
    constant, helper = whole_copy / "sags_node/made/deep.py", whole_copy / "sags_node/made/helper.py"
    assert run(whole_copy, CALLED) == [20, 10, *COMPILED]
    assert run(whole_copy, CALLED) == [20, 10, *LOADED]
    edit(constant, "2.0", "7.25")
    assert run(whole_copy, CALLED) == [72.5, 10, *COMPILED]
    edit(helper, "x + 1.0", "x + 11.0")
    assert run(whole_copy, CALLED) == [145, 20, *COMPILED]
    edit(helper, "x + 11.0", "x + 1.0")
    assert run(whole_copy, CALLED) == [72.5, 10, *LOADED]  # the former state is still there


def test_what_changes_while_a_process_runs_is_not_taken_for_what_it_imported(whole_copy: Path) -> None:
    """Lazy imports in a node that runs while the package is updated."""
    file = whole_copy / "sags_node/made/deep.py"
    before = run(whole_copy, CALLED)[0]
    update = (
        f"import pathlib, sags_node.kernels.jit, sags_node.made.constants\np = pathlib.Path({str(file)!r})\n"
    )
    update += "p.write_text(p.read_text() + ' * 100')\n"
    assert run(whole_copy, update + CALLED)[0] == before
    assert run(whole_copy, CALLED)[0] == 100 * before


def test_kernels_outside_the_package_are_not_kept() -> None:
    """What they import is not known."""

    @kernel
    def here(x: float) -> float:
        return x + 1

    assert here(1.0) == 2.0
    assert here._cache.cache_path is None  # type: ignore[attr-defined]
    assert digest.kernel_name(here.py_func) is None  # type: ignore[attr-defined]


def test_every_kernel_is_compiled_by_the_decorators_that_know_the_cache() -> None:
    """And no import is relative: those are found by their full names."""
    compilers = r"\b(n?jit|(gu)?vectorize|cfunc|stencil|generated_jit)\b"
    wrong = re.compile(
        rf"numba\.{compilers}|^\s*from (numba import (\([^)]*|.*){compilers}|\.)", re.MULTILINE
    )
    files = [each for each in PACKAGE.rglob("*.py") if not each.is_relative_to(PACKAGE / "kernels")]
    found = {each.relative_to(PACKAGE).as_posix(): wrong.search(each.read_text()) for each in files}
    assert not [f"{name}: {match[0]}" for name, match in found.items() if match]


# ---- never mixed -------------------------------------------------------------------------------------------


def test_compile_targets_and_settings_lie_side_by_side(whole_copy: Path) -> None:
    target = {"NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": ""}
    run(whole_copy, CALLED)
    assert run(whole_copy, CALLED, **target)[2:] == COMPILED
    assert run(whole_copy, CALLED, NUMBA_OPT="1")[2:] == COMPILED
    assert run(whole_copy, CALLED, **target)[2:] == LOADED
    assert run(whole_copy, CALLED, NUMBA_NUM_THREADS="1")[2:] == LOADED  # the same machine code


def test_processes_that_compile_one_kernel_for_several_types_at_once(whole_copy: Path) -> None:
    """Each reads the index, adds its entry and writes it: all must be there in the end."""
    types = ["float32", "float64", "int32", "int64"]
    code = """
import json, time, numpy as np
from numba.core.caching import IndexDataCacheFile
from sags_node.made.caller import scaled
write = IndexDataCacheFile._save_index
IndexDataCacheFile._save_index = lambda *index: (time.sleep(0.3), write(*index))
used = [scaled]
intervals = [scaled(getattr(np, kind)(4)) for kind in {}]
"""
    edit(whole_copy / "sags_node/made/deep.py", "FACTOR = ", "FACTOR = 1.5 * ")  # nothing of it on disk yet
    processes = [start(whole_copy, code.format([kind]) + COUNTED) for kind in types]
    alone = [numbers(process.said()) for process in processes]
    together = run(whole_copy, code.format(types))
    assert together == [*(found[0] for found in alone), 0, len(types)]


def test_a_process_that_compiles_computes_the_bits_of_one_that_loads(whole_copy: Path) -> None:
    """Each kernel runs its own copy of a helper, whatever else the process has compiled or loaded."""
    compiles, loads = (run(whole_copy, LOSS) for _ in range(2))
    assert [compiles[2:], loads[2:]] == [[1, 0], [0, 1]]
    assert compiles[:2] == loads[:2] and compiles[1] == 0


# ---- never in the way --------------------------------------------------------------------------------------


def test_damaged_files_are_compiled_anew(whole_copy: Path) -> None:
    """As after a power cut."""
    before = run(whole_copy, CALLED)
    for ending, left in ((".nbi", 0), (".nbc", 40)):
        for file in (whole_copy / "cache").rglob(f"*{ending}"):
            file.write_bytes(file.read_bytes()[:left])
        assert run(whole_copy, CALLED) == [*before[:2], *COMPILED]
    assert run(whole_copy, CALLED)[2:] == LOADED


def test_a_full_disk_costs_the_cache_and_nothing_else(whole_copy: Path, tmp_path: Path) -> None:
    full = "import resource, signal\nsignal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
    full += "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
    for _ in range(2):
        said = start(whole_copy, full + CALLED + COUNTED, cache=tmp_path).said()
        assert numbers(said)[2:] == COMPILED
        assert said.stderr.count("cannot be kept") == 1


def test_place_of_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first place that can be written, by this user only."""
    find = cache_root.__wrapped__
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "chosen"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    assert find() == tmp_path / "chosen/sags"
    (tmp_path / "chosen/sags").chmod(0o777)
    assert find() == tmp_path / "home/sags/kernels"
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    assert find() == tmp_path / "home/sags/kernels"
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null")
    own = find()
    assert own is not None and own.name == f"sags-kernels-{os.getuid()}" and own.stat().st_mode & 0o077 == 0


def test_folders_that_were_not_used_for_longest_are_cleared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache, "KEPT", 3)
    monkeypatch.setattr(cache, "cache_root", lambda: tmp_path)
    used = str(digest.kernel_name(to_pixel.py_func))  # type: ignore[attr-defined]
    names = [*(f"engine.{name}-1" for name in "abcd"), used]
    for age, name in enumerate(names):
        (tmp_path / name).mkdir()
        (tmp_path / f"{name}/index").touch()
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    assert not cache.is_cold(to_pixel)
    cache.clear_old(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {*names[:2], used}


def test_a_kernel_is_cold_until_it_was_compiled_once(whole_copy: Path, tmp_path: Path) -> None:
    code = """
import json
from sags_node.kernels.cache import is_cold
from sags_node.made.caller import scaled
before = is_cold(scaled)
scaled(9.0)
print(json.dumps([before, is_cold(scaled)]))
"""
    for expected in ([True, False], [False, False]):
        assert numbers(start(whole_copy, code, cache=tmp_path).said()) == expected
