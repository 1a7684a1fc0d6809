"""Checks a built site: check_site.py links SITE, or check_site.py pictures SITE --out FOLDER.

``pictures`` needs chromium and chromedriver, and serves the site to them on this machine alone.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import functools
import posixpath
import shutil
import sys
import threading
import urllib.parse
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path

from bs4 import BeautifulSoup
from PIL import Image
from selenium import webdriver

# Name, width, colours: both kinds of screen, both colour schemes.
SCREENS = (("desk", 1280, "light"), ("phone", 390, "dark"))
MAX_HEIGHT = 3_000

# What is wrong with the page that is open, as a list of sentences.
LOOK = """
const done = arguments[0], width = document.documentElement.clientWidth, found = [];
const settled = window.MathJax ? MathJax.startup.promise : Promise.resolve();
settled.then(() => {
  if (document.documentElement.scrollWidth > width) {
    const wide = [...document.querySelectorAll("article *")].find(e => e.getBoundingClientRect().right > width + 1);
    found.push(`wider than the screen: ${(wide || document.body).outerHTML.slice(0, 200)}`);
  }
  for (const image of document.images)
    if (!image.complete || image.naturalWidth === 0) found.push(`image not loaded: ${image.src}`);
  for (const error of document.querySelectorAll("mjx-merror")) found.push(`bad formula: ${error.textContent}`);
  if (document.querySelector(".main").innerText.trim().length < 20) found.push("no text");
  done(found);
});
"""


class Quiet(SimpleHTTPRequestHandler):
    """Serves files and says nothing."""

    def log_message(self, format: str, *args: object) -> None:
        pass


@contextlib.contextmanager
def served(site: Path) -> Iterator[str]:
    """The address of the site while the context lasts."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=site))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()


def pages_of(site: Path) -> list[str]:
    """All pages, relative to the site."""
    return sorted(str(file.relative_to(site)) for file in site.rglob("*.html") if "_static" not in file.parts)


def check_links(site: Path) -> int:
    """Every link, picture and anchor that points into the site must be there."""
    texts = {page: BeautifulSoup((site / page).read_bytes(), "html.parser") for page in pages_of(site)}
    anchors = {page: {tag["id"] for tag in text.find_all(id=True)} for page, text in texts.items()}
    broken, seen = [], 0
    for page, text in texts.items():
        for tag in text.find_all(["a", "img", "link", "script"]):
            link = tag.get("href") or tag.get("src") or ""
            parts = urllib.parse.urlsplit(link)
            if parts.scheme or parts.netloc or not link:
                continue
            seen += 1
            path, anchor = urllib.parse.unquote(parts.path), urllib.parse.unquote(parts.fragment)
            target = posixpath.normpath(posixpath.join(posixpath.dirname(page), path)) if path else page
            there = (site / target).is_file()
            # Sphinx links a source's objects all by the name that one of them has: the page is right, not each anchor.
            loose = page.startswith("_modules/") and not target.startswith("_modules/")
            if not there or (anchor and not loose and anchor not in anchors.get(target, ())):
                broken.append(f"{page}: {link}")
    print("\n".join(sorted(set(broken))), file=sys.stderr, end="\n" if broken else "")
    print(f"{seen} links within {len(texts)} pages, {len(broken)} broken")
    return min(len(broken), 1)


def check_pictures(site: Path, out: Path) -> int:
    """Opens every page on every screen, keeps its picture, and says what is wrong."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    failures = 0
    pages = [page for page in pages_of(site) if not page.startswith("_modules/")]  # which are sources, all alike
    with served(site) as address, browser() as driver:
        for page in pages:
            for number, (name, width, colours) in enumerate(SCREENS):
                size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
                driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
                scheme = [{"name": "prefers-color-scheme", "value": colours}]
                driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": scheme})
                if number == 0:  # the other screens show the page that is there, as a window that is made narrower does
                    driver.get(f"{address}/{page}")
                found = driver.execute_async_script(LOOK)
                found += [f"browser: {e['message']}" for e in driver.get_log("browser") if e["level"] == "SEVERE"]
                picture = picture_of(driver, width)
                (out / f"{page.removesuffix('.html').replace('/', '-')}-{name}.png").write_bytes(picture)
                if is_blank(Image.open(BytesIO(picture))):
                    found.append("blank")
                for sentence in found:
                    print(f"{page} ({name}): {sentence}", file=sys.stderr)
                failures += len(found)
    print(f"{len(pages)} pages on {len(SCREENS)} screens, {failures} faults; pictures in {out}")
    return min(failures, 1)


@contextlib.contextmanager
def browser() -> Iterator[webdriver.Chrome]:
    """Headless Chromium with a profile of its own."""
    options = webdriver.ChromeOptions()
    options.binary_location = str(shutil.which("chromium"))
    flags = "headless no-sandbox disable-gpu hide-scrollbars disable-background-networking disable-component-update"
    for flag in (*flags.split(), "disable-dev-shm-usage", "no-first-run"):
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    # A driver that is named is not looked for on the network.
    driver = webdriver.Chrome(options, webdriver.ChromeService(shutil.which("chromedriver")))
    try:
        yield driver
    finally:
        driver.quit()


def picture_of(driver: webdriver.Chrome, width: int) -> bytes:
    """The page down to ``MAX_HEIGHT``, as a PNG, larger and sooner there than the smallest one."""
    height = min(driver.execute_script("return document.documentElement.scrollHeight"), MAX_HEIGHT)
    clip = {"x": 0, "y": 0, "width": width, "height": height, "scale": 1}
    how = {"captureBeyondViewport": True, "optimizeForSpeed": True, "clip": clip}
    return base64.b64decode(driver.execute_cdp_cmd("Page.captureScreenshot", how)["data"])


def is_blank(picture: Image.Image) -> bool:
    """Whether hardly anything differs from anything."""
    darkest, lightest = picture.convert("L").getextrema()
    return lightest - darkest < 64


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=["links", "pictures"])
    parser.add_argument("site", type=Path)
    parser.add_argument("--out", type=Path, default=Path("pictures"), help="where pictures are kept")
    arguments = parser.parse_args()
    if arguments.part == "links":
        return check_links(arguments.site)
    return check_pictures(arguments.site, arguments.out)


if __name__ == "__main__":
    sys.exit(main())
