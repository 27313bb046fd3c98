# SPDX-License-Identifier: Apache-2.0
"""Chromium, problems of its pages, and live views and replays to open in it."""

import contextlib
import json
import shutil
import threading

# Root and most containers cannot have a sandbox, and all pages are our own.
_OPTIONS = (
    *("--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update"),
    *("--disable-sync", "--disable-default-apps"),
)


@contextlib.contextmanager
def chromium():
    """Yield a function that starts the system's Chromium, or else Playwright's."""
    # Environments without a browser have no Playwright.
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        found = shutil.which("chromium") or playwright.chromium.executable_path
        yield lambda: playwright.chromium.launch(executable_path=found, args=_OPTIONS)


def complaints_of(page, own):
    """Return a list that collects a page's errors, dialogs and foreign requests.

    Args:
        page: a new page.
        own: the prefixes of URLs that it may request.
    """
    complaints = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("dialog", lambda shown: complaints.append(f"dialog: {shown.message}"))

    def check(request):
        if not request.url.startswith(own):
            complaints.append(request.url)

    page.on("request", check)
    return complaints


def barriers_of(page, **options):
    """Return the serious accessibility problems that axe-core finds in a page."""
    from axe_playwright_python.sync_playwright import Axe

    return [
        (each["id"], [node["html"][:200] for node in each["nodes"]][:3])
        for each in Axe().run(page, **options).response["violations"]
        if each["impact"] in ("serious", "critical")
    ]


@contextlib.contextmanager
def served(directory):
    """Yield a live view of a directory, served by a thread."""
    # It needs packages that environments without a browser lack.
    from mjrec.viewing.live import LiveView

    with LiveView(directory) as view:
        thread = threading.Thread(target=view.serve)
        thread.start()
        try:
            yield view
        finally:
            view.close()
            thread.join()


def data_of(page):
    """Return the data that the script of a replay's page reads."""
    return json.loads(page.split('id="replay-data">')[1].split("</script>")[0])
