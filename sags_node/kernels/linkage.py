"""Each kernel runs its own copy of the helpers that it calls.

Numba links a helper into every kernel that calls it and optimises it there again. The copies differ, and so
do the last digits of what they compute. All copies have one name, and the loader uses the one that it loaded
first: the helper's own in a process that compiles, that of some kernel in a process that loads from disk. So
a recording gave other figures at the first start than at all later ones. With this module a copy is visible
only to its own kernel.
"""

from typing import Any

from llvmlite.binding import Linkage
from numba.core.codegen import JITCodeLibrary
from numba.core.registry import cpu_target


class _Library(JITCodeLibrary):  # type: ignore[misc]  # Numba has no types
    """A function's machine code, with private copies of its helpers."""

    _helpers: tuple[str, ...] = ()  # functions that were linked in; none in code from disk, linked before

    def _finalize_final_module(self) -> None:
        functions = self._final_module.functions
        linked = [each for each in functions if each.linkage == Linkage.linkonce_odr]
        self._helpers = tuple(each.name for each in linked if not each.is_declaration)
        self._link(self._final_module, "internal")
        super()._finalize_final_module()

    def _get_module_for_linking(self) -> Any:
        """Return the module that is linked into callers. The helpers are public in it: callers name them."""
        module = super()._get_module_for_linking()
        self._link(module, "linkonce_odr")
        return module

    def _link(self, module: Any, linkage: str) -> None:
        for name in self._helpers:
            module.get_function(name).linkage = linkage


def keep_helpers_apart() -> None:
    """Give each kernel private helpers in all that Numba compiles in this process from now on."""
    cpu_target.target_context.codegen()._library_class = _Library
