"""A page in the system's Chromium."""

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium")


@contextmanager
def new_page(arguments: Sequence[str] = (), **how: Any) -> Iterator[Any]:
    """An empty one, of a browser started with these arguments; where there is none the test is skipped."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed (extra: dev)")
    if CHROMIUM is None:
        pytest.skip("there is no chromium on this machine (Debian: chromium)")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *arguments])
        try:
            yield browser.new_page(**how)
        finally:
            browser.close()
