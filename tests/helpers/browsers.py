"""A page in the system's Chromium."""

import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium")
_open: list[Any] = []  # the driver, while a page is open: a process can have one


@contextmanager
def new_page(arguments: Sequence[str] = (), **how: Any) -> Iterator[Any]:
    """An empty one, of a browser started with these arguments; where there is none the test is skipped."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed (extra: dev)")
    if CHROMIUM is None:
        pytest.skip("there is no chromium on this machine (Debian: chromium)")
    with ExitStack() as stack:
        if not _open:
            _open.append(stack.enter_context(playwright.sync_playwright()))
            stack.callback(_open.pop)
        browser = _open[0].chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *arguments])
        stack.callback(browser.close)
        yield browser.new_page(**how)
