# SPDX-License-Identifier: Apache-2.0
"""Start the system's Chromium with Playwright's driver, as the tests do."""

from __future__ import annotations

import shutil

from playwright.sync_api import sync_playwright

with sync_playwright() as playwright:
    browser = playwright.chromium.launch(
        executable_path=shutil.which("chromium"),
        args=["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"],
    )
    page = browser.new_page()
    page.set_content("<title>started</title>")
    assert page.title() == "started"
    browser.close()
