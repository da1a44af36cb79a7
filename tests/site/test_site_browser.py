"""The built site in a real browser: every picture opens, no page is too wide or loads from elsewhere, search finds.

Skipped without Chromium, and where `make docs` has not built the site.
"""

from __future__ import annotations

import json
import queue
import shutil
import subprocess
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from places import ROOT

SITE = ROOT / "build" / "site"
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
PATIENCE_S = 600

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="no Chromium here"),
    pytest.mark.skipif(not (SITE / "index.html").is_file(), reason="`make docs` has not built the site"),
]

LOOK = """<!doctype html><body><script>
const pages = PAGES;
async function look() {
  const found = [];
  let pictures = 0;
  for (const width of [1360, 420]) {
    const frame = document.body.appendChild(document.createElement("iframe"));
    frame.style.cssText = `width: ${width}px; height: 900px; border: 0`;
    for (const page of pages) {
      await new Promise(done => { frame.onload = done; frame.src = "/" + page; });
      const inside = frame.contentDocument;
      for (const picture of inside.images) {
        picture.loading = "eager";
        const name = (picture.getAttribute("src") || "").slice(0, 80);
        await picture.decode().catch(() => found.push(`${page}: the picture ${name} does not open`));
        pictures += 1;
      }
      for (const {name} of frame.contentWindow.performance.getEntriesByType("resource")) {
        if (!name.startsWith(location.origin) && !name.startsWith("data:")) found.push(`${page}: loads ${name}`);
      }
      const over = inside.documentElement.scrollWidth - width;
      if (over > 0) found.push(`${page}: ${over} px wider than ${width}`);
    }
    frame.remove();
  }
  const frame = document.body.appendChild(document.createElement("iframe"));
  await new Promise(done => { frame.onload = done; frame.src = "/search.html?q=dwell_s"; });
  let hits = 0;
  for (let tries = 0; tries < 100 && !hits; tries += 1) {
    await new Promise(done => setTimeout(done, 100));
    hits = frame.contentDocument.querySelectorAll("ul.search li").length;
  }
  await fetch("/found", {method: "POST", body: JSON.stringify({found, pictures, hits})});
}
look();
</script>"""


def look(site: Path, profile: Path) -> dict[str, Any]:
    """What a browser finds wrong with the pages of a folder, and how many pictures it opened."""
    answers: queue.Queue[bytes] = queue.Queue()
    pages = sorted(page.relative_to(site).as_posix() for page in site.rglob("*.html") if "_static" not in page.parts)

    class Handler(SimpleHTTPRequestHandler):
        def __init__(self, *args: Any) -> None:
            super().__init__(*args, directory=str(site))

        def do_GET(self) -> None:
            if self.path != "/look":
                return super().do_GET()
            body = LOOK.replace("PAGES", json.dumps(pages)).encode()
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def do_POST(self) -> None:
            answers.put(self.rfile.read(int(self.headers["Content-Length"])))
            self.send_response(204)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            """Nothing: the output belongs to pytest."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        arguments = [f"--user-data-dir={profile}", "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run"]
        address = f"http://127.0.0.1:{server.server_port}/look"
        with subprocess.Popen([str(BROWSER), *arguments, address], stderr=subprocess.DEVNULL) as browser:
            try:
                return json.loads(answers.get(timeout=PATIENCE_S))
            finally:
                browser.terminate()
                server.shutdown()


@pytest.fixture
def broken(tmp_path: Path) -> Path:
    """A site of one page: a picture that is not there, a script from elsewhere, a line that is too long."""
    folder = tmp_path / "broken"
    folder.mkdir()
    far = '<script src="http://localhost:9/far.js"></script>'
    wide = '<p style="width: 900px">wide</p>'
    (folder / "index.html").write_text(
        f'<!doctype html><title>broken</title><img src="gone.png" alt="gone">{far}{wide}'
    )
    return folder


def test_every_picture_opens_every_page_fits_and_the_search_finds(tmp_path: Path) -> None:
    answer = look(SITE, tmp_path / "profile")
    assert answer["found"] == []
    assert answer["pictures"] > 20
    assert answer["hits"] >= 3


def test_a_missing_picture_a_wide_page_and_a_script_from_elsewhere_are_found(broken: Path, tmp_path: Path) -> None:
    answer = look(broken, tmp_path / "profile")
    assert "index.html: the picture gone.png does not open" in answer["found"]
    assert "index.html: loads http://localhost:9/far.js" in answer["found"]
    assert any("px wider than 420" in line for line in answer["found"])
    assert answer["hits"] == 0
