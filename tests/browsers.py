# SPDX-License-Identifier: Apache-2.0
"""Chromium, and what it says of a page."""

import contextlib
import shutil

# No sandbox, which root and most containers cannot have: it opens our own pages only.
_OPTIONS = (
    *("--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update"),
    *("--disable-sync", "--disable-default-apps"),
)


@contextlib.contextmanager
def chromium():
    """Yield what starts the system's Chromium, or the one that Playwright has."""
    # Here, because the environments without a browser have no Playwright.
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        found = shutil.which("chromium") or playwright.chromium.executable_path
        yield lambda: playwright.chromium.launch(executable_path=found, args=_OPTIONS)


def complaints_of(page, own):
    """Return the list of the page's errors and dialogs to come, and of its requests.

    Args:
        page: a new page.
        own: beginnings of the addresses that it may ask for.
    """
    said = []
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("dialog", lambda shown: said.append(f"dialog: {shown.message}"))
    page.on(
        "request",
        lambda asked: None if asked.url.startswith(own) else said.append(asked.url),
    )
    return said


def barriers_of(page, **options):
    """Return what axe-core finds that keeps people out of a page."""
    from axe_playwright_python.sync_playwright import Axe

    return [
        (each["id"], [node["html"][:200] for node in each["nodes"]][:3])
        for each in Axe().run(page, **options).response["violations"]
        if each["impact"] in ("serious", "critical")
    ]
