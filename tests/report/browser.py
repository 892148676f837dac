"""A real browser without a screen, where this machine has one, that opens a page offline and measures it."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome", "chrome")
# Nothing may be looked up outside: a browser left to itself asks for updates at every start.
_OFFLINE = ("--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-quic")
_MEASURE = """<script>
addEventListener("load", () => {
  const box = e => { const r = e.getBoundingClientRect(); return {width: r.width, height: r.height, top: r.top}; };
  const all = s => [...document.querySelectorAll(s)].map(box);
  parent.document.body.innerHTML = "<pre id=measured></pre>".replace("><", ">" + JSON.stringify({
    page: document.documentElement.scrollWidth, window: innerWidth, verdict: box(document.querySelector(".verdict")),
    figures: all("figure svg"), tables: all("table"), boxes: [...document.querySelectorAll(".wide")].map(e => ({
      ...box(e), inside: e.clientWidth, content: e.scrollWidth, overflow: getComputedStyle(e).overflowX,
      name: e.querySelector("th").innerText})), text: document.body.innerText,
    fetched: performance.getEntriesByType("resource").length,
  }).replace(/&/g, "&amp;").replace(/</g, "&lt;") + "<");
});
</script>"""


@cache
def find_browser() -> str | None:
    """The first browser of `NAMES` that opens a page here: some systems install a stub of that name, or one that may
    not read temporary files."""
    with TemporaryDirectory() as folder:
        page = Path(folder) / "page.html"
        page.write_text("<!DOCTYPE html><title>t</title><p>it opens</p>", encoding="utf-8")
        found = (path for name in NAMES if (path := shutil.which(name)))
        return next((path for path in found if "it opens" in _dom(path, page, Path(folder))), None)


def measured(browser: str, page: Path, folder: Path, width: int) -> dict[str, Any]:
    """Sizes of what a browser shows of a page in a view of this width, in pixels, its text, and what it fetched.

    The view is a frame: a browser's window is never narrower than 500 pixels, whatever it is asked for.
    """
    copy = folder / f"measured-{width}.html"
    text = html.escape(page.read_text(encoding="utf-8").replace("</body>", _MEASURE + "</body>"))
    frame = f'<iframe style="width: {width}px; height: 900px; border: 0" srcdoc="{text}"></iframe>'
    copy.write_text(f'<!DOCTYPE html><html><head><meta charset="utf-8"></head><body>{frame}</body></html>', "utf-8")
    dom = _dom(browser, copy, folder)
    found = re.search(r'<pre id="?measured"?>(.*?)</pre>', dom, re.DOTALL)
    assert found, dom[-500:]
    result: dict[str, Any] = json.loads(html.unescape(found[1]))
    assert result["window"] == width
    return result


def _dom(browser: str, page: Path, folder: Path) -> str:
    """The page as the browser has it once it is loaded; empty where it does not start."""
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", *_OFFLINE]
    command += [f"--user-data-dir={folder / 'profile'}", "--window-size=1400,1000", "--dump-dom", page.as_uri()]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=60).stdout
    except (OSError, subprocess.TimeoutExpired):
        return ""
