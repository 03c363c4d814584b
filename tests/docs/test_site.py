"""The built site: pages that fit a phone, colours of the system, and rig keys that the search finds."""

import functools
import http.server
import json
import re
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from tests.emulator.live_page.browser import CHROMIUM, Browser

ROOT = Path(__file__).parents[2]
# Pages with the widest tables, code and pictures.
PAGES = ("index.html", "rigs/", "matrix/", "faults/", "gallery/", "tutorial/")
OVERFLOW_PX = "document.readyState == 'complete' && [document.documentElement.scrollWidth - innerWidth]"
SCHEME = "document.body.getAttribute('data-md-color-scheme')"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Build all pages without the API reference, which takes most of the time."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "mkdocs.yml").write_text(
        f"INHERIT: {ROOT}/mkdocs.yml\ndocs_dir: {ROOT}/docs\nsite_dir: {folder}/site\nplugins: [search]\n"
    )
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--config-file", folder / "mkdocs.yml"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return folder / "site"


@pytest.fixture
def address(site):
    """Serve the site on a free port."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_):
            """Print nothing."""

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=site))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.mark.system
def test_the_search_index_has_each_rig_key(site):
    index = json.loads((site / "search/search_index.json").read_text())
    found = {one["location"]: one["title"] for one in index["docs"] if one["location"].startswith("rigs/#")}
    keys = re.findall(r'<h4 id="([^"]+)"><code>(\w+)</code>', (ROOT / "docs/rigs.md").read_text())
    assert len(keys) > 500
    assert [key for key in keys if key[1] not in found.get(f"rigs/#{key[0]}", "")] == []


@pytest.mark.long
@pytest.mark.system
@pytest.mark.chromium
@pytest.mark.socket
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium")
def test_pages_fit_a_phone_in_the_colours_of_the_system(address, tmp_path):
    with Browser(tmp_path, (390, 844)) as browser:
        browser.resize(390, 844, phone=True)
        for number, page in enumerate(PAGES):
            colours = ("light", "dark")[number % 2]
            feature = {"name": "prefers-color-scheme", "value": colours}
            browser.call("Emulation.setEmulatedMedia", media="screen", features=[feature])
            browser.open(f"{address}/{page}?{number}")
            overflow_px = browser.until(f"location.search == '?{number}' && {OVERFLOW_PX}")
            assert overflow_px == [0], page
            assert browser.value(SCHEME) == {"light": "default", "dark": "slate"}[colours]
        assert browser.errors == []
