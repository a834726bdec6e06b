"""What tests in Debian's Chromium need; modules that import this are skipped, with a reason, without it."""

import shutil

import pytest

playwright = pytest.importorskip("playwright.sync_api", reason="no playwright: pip install '.[browser]'")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
NEEDED = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium: apt-get install chromium"),
]
