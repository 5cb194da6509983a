"""Every Triton kernel compiles for a GPU, down to machine code, on a machine that has none.

Triton brings its own assembler. It runs in processes of their own, since this one may have its interpreter.
"""

from __future__ import annotations

import importlib
import json
import os
import pkgutil
import re
import subprocess
import sys
import tempfile
from typing import Any

import pytest
from places import HELPERS, ROOT

pytest.importorskip("triton", reason="Triton comes with torch's CUDA builds, or by `pip install triton`")

ARCHITECTURES = [80, 90]  # A100, H100
MAX_SHARED = 99 * 1024  # bytes a program may take on every GPU since 2020
MAX_SPILLED = 128  # bytes per thread: some registers more than a thread has, not a loop's worth


def modules() -> list[Any]:
    """All of the package, sub-packages as well."""
    from sags_node.engine import cuda

    found = pkgutil.walk_packages(cuda.__path__, "sags_node.engine.cuda.")
    return [importlib.import_module(entry.name) for entry in found]


def compile_all(architecture: int) -> None:
    """Print a line of JSON for each variant of each kernel."""
    import triton

    for module in modules():
        for variant in getattr(module, "SIGNATURES", ()):
            line = {"kernel": f"{module.__name__.rpartition('.')[2]}.{variant.kernel.__name__}"}
            line["constexprs"] = {name: str(value) for name, value in variant.constexprs.items()}
            try:
                line |= compile_one(variant, architecture)
            except (triton.CompilationError, RuntimeError) as error:
                line["error"] = str(error)
            print(json.dumps(line), flush=True)


def compile_one(variant: Any, architecture: int) -> dict[str, int]:
    """Registers per thread, spilled bytes per thread, and shared memory, bytes."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    names = variant.kernel.arg_names
    assert set(names) == set(variant.signature) | set(variant.constexprs), "arguments are listed wrongly"
    types = {name: variant.signature.get(name, "constexpr") for name in names}
    # torch's memory is aligned: so does the launcher find it, too
    aligned = {
        (index,): [["tt.divisibility", 16]] for index, name in enumerate(names) if types[name].startswith("*")
    }
    source = ASTSource(variant.kernel, types, dict(variant.constexprs), aligned)
    compiled = triton.compile(
        source, target=GPUTarget("cuda", architecture, 32), options={"num_warps": variant.num_warps}
    )
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(compiled.asm["cubin"])
        file.flush()
        usage = subprocess.run(
            [triton.knobs.nvidia.cuobjdump.path, "--dump-resource-usage", file.name],
            capture_output=True, text=True, check=True,
        ).stdout  # fmt: skip
    registers, stack, local = (
        int(number) for name in ("REG", "STACK", "LOCAL") for number in re.findall(rf"\b{name}:(\d+)", usage)
    )
    return {"registers": registers, "spilled": stack + local, "shared": compiled.metadata.shared}


@pytest.fixture(scope="module")
def compiled() -> dict[int, list[dict[str, Any]]]:
    """What `compile_all` prints, by architecture; both at once."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    environment["PYTHONPATH"] = os.pathsep.join([str(HELPERS), environment.get("PYTHONPATH", "")])
    running = {
        architecture: subprocess.Popen(
            [sys.executable, __file__, str(architecture)],
            env=environment, cwd=ROOT, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )
        for architecture in ARCHITECTURES
    }  # fmt: skip
    found = {}
    for architecture, process in running.items():
        printed, complaints = process.communicate()
        assert process.returncode == 0, complaints
        found[architecture] = [json.loads(line) for line in printed.splitlines()]
    return found


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_every_kernel_compiles_and_fits_the_registers(
    compiled: dict[int, list[dict[str, Any]]], architecture: int
) -> None:
    variants = compiled[architecture]
    assert len(variants) > 10
    failed = [f"{found['kernel']}: {found['error']}" for found in variants if "error" in found]
    assert not failed, "\n".join(failed)
    heavy = [v for v in variants if v["spilled"] > MAX_SPILLED or v["shared"] > MAX_SHARED]
    assert not heavy, heavy


def test_every_kernel_is_listed() -> None:
    """A kernel asks for its program's number; a function that only kernels call does not."""
    from triton.runtime import JITFunction
    from triton.runtime.interpreter import InterpretedFunction

    missing = []
    for module in modules():
        listed = {variant.kernel.__name__ for variant in getattr(module, "SIGNATURES", ())}
        for name, value in vars(module).items():
            own = (
                isinstance(value, JITFunction | InterpretedFunction)
                and value.fn.__module__ == module.__name__
            )
            if own and "program_id" in value.fn.__code__.co_names and name not in listed:
                missing.append(f"{module.__name__}.{name}")
    assert not missing, f"not in SIGNATURES of their modules: {missing}"


if __name__ == "__main__":
    compile_all(int(sys.argv[1]))
