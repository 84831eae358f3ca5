"""Opens every page of the built book in headless Chromium: `make site`.

Light and dark, wide and narrow. No page may ask another host for anything, nor log an error, nor
be wider than the screen; on a phone the menu must open; every 3D figure must be drawn, turn under
the mouse and play. Pictures of all pages are left in _build/shots.
"""

import http.server
import shutil
import threading
from functools import partial
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SITE, SHOTS = ROOT / "_build/html", ROOT / "_build/shots"
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
PAGES = sorted(p.relative_to(SITE).as_posix() for p in SITE.glob("*/*.html") if not p.parent.name.startswith("_"))

pytestmark = [
    pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed"),
    pytest.mark.skipif(not PAGES, reason="the book is not built: run make book"),
]


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def address():
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=SITE))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()


@pytest.fixture(scope="module")
def browser():
    from playwright.sync_api import sync_playwright

    quiet = ["--no-sandbox", "--disable-background-networking", "--disable-component-update", "--disable-sync",
             "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]  # fmt: skip
    with sync_playwright() as play, play.chromium.launch(executable_path=CHROMIUM, args=quiet) as browser:
        yield browser


@pytest.mark.parametrize("width", [1400, 390])
@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("name", PAGES)
def test_page(browser, address, name, theme, width):
    page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=theme)
    foreign, errors = [], []
    page.on("request", lambda r: None if r.url.startswith((address, "data:", "blob:")) else foreign.append(r.url))
    page.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
    page.on("pageerror", lambda e: errors.append(str(e)))
    page.on("response", lambda r: errors.append(f"{r.status} {r.url}") if r.status >= 400 else None)
    page.goto(f"{address}/{name}", wait_until="networkidle")
    for figure in page.query_selector_all(".plotly-figure"):
        figure.scroll_into_view_if_needed()
        page.wait_for_function("f => f._fullLayout && f.querySelector('canvas')", arg=figure)
        turn(page, figure)
    SHOTS.mkdir(parents=True, exist_ok=True)
    page.evaluate("scrollTo(0, 0)")
    height = page.evaluate("document.documentElement.scrollHeight")
    for part, top in enumerate(range(0, height, 8000)):  # Chromium repeats itself in pictures taller than 8192 pixels
        clip = {"x": 0, "y": top, "width": width, "height": min(8000, height - top)}
        page.screenshot(path=SHOTS / f"{Path(name).stem}-{theme}-{width}-{part}.png", full_page=True, clip=clip)
    if width < 600:
        page.click(".primary-toggle:visible")
        page.wait_for_selector("nav.bd-links:visible")  # the menu opens
    overflow = page.evaluate("document.documentElement.scrollWidth - innerWidth")
    page.close()
    assert not foreign, foreign
    assert not errors, errors
    assert overflow <= 0, f"the page is {overflow} px wider than the screen"


def turn(page, figure):
    """Drag the figure's scene and step its slider; both must change what is shown."""
    look = "f => JSON.stringify(f._fullLayout.scene._scene.getCamera().eye)"
    page.wait_for_timeout(500)
    box, before = figure.bounding_box(), figure.evaluate(look)
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] * 0.45)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2 + 90, box["y"] + box["height"] * 0.4, steps=8)
    page.mouse.up()
    page.wait_for_timeout(300)
    assert figure.evaluate(look) != before, "the figure does not turn"
    pose = "f => JSON.stringify(Array.from(f._fullData[0].x).slice(0, 6))"
    before = figure.evaluate(pose)
    figure.query_selector(".updatemenu-button").click()  # play
    page.wait_for_timeout(1500)
    assert figure.evaluate(pose) != before, "the figure does not play"
    figure.query_selector_all(".updatemenu-button")[1].click()  # pause
