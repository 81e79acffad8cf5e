"""The page in a browser: it opens from disk, flips, sorts, shows its curves, asks the network for nothing, complains of nothing.

Without a browser it is skipped, but fails where `OLPM_BENCH_NEEDS_BROWSER` is set, as continuous integration does that has one.
"""
from __future__ import annotations

import os
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from skimage.io import imread

from olpm_bench.bench import summary
from olpm_bench.report import figures, page, sheet

pytest.importorskip("jinja2", reason="needs the extra report")
pytest.importorskip("simpleimageio", reason="needs the extra report")
driver = pytest.importorskip("playwright.sync_api", reason="needs the extra dev")

NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
SECOND = (0, 0x72, 0xB2)                # colour of the second method


@pytest.fixture()
def opened(finished, tmp_path):
    """page, complaints, requests: the report in a browser 1000 pixels wide, once its images are drawn."""
    executable = next(filter(None, map(shutil.which, NAMES)), None)
    if executable is None:
        missing = pytest.fail if "OLPM_BENCH_NEEDS_BROWSER" in os.environ else pytest.skip
        missing(f"needs a browser on the PATH: {', '.join(NAMES)}")
    rows = summary.summarise(finished)["rows"]
    figures.curves(finished)
    figures.gains(finished, rows)
    page.page(finished, rows, sheet.blocks(finished), ["figure", "gains"])
    complaints, requests = [], []
    with driver.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=["--no-sandbox"])      # root needs that
        tab = browser.new_page(viewport={"width": 1000, "height": 1000})
        tab.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
        tab.on("pageerror", lambda error: complaints.append(str(error)))
        tab.on("request", lambda request: requests.append(request.url))
        tab.goto((finished.results.folder / "report.html").as_uri())
        tab.wait_for_selector(".viewer canvas", state="visible", timeout=60_000)
        yield SimpleNamespace(page=tab, complaints=complaints, requests=requests)
        browser.close()


def seen(tab, tmp_path) -> np.ndarray:
    """What the viewer's image area shows, once it has been drawn."""
    tab.wait_for_timeout(500)           # the viewer draws ten times a second
    tab.locator(".viewer").screenshot(path=tmp_path / "seen.png")
    return imread(tmp_path / "seen.png")[100:350, :, :3].astype(int)


def test_it_opens_flips_and_sorts_without_a_network_and_without_complaint(opened, tmp_path):
    tab = opened.page
    tab.locator(".viewer canvas").first.hover()
    shown = [seen(tab, tmp_path)]
    for key in ("2", "3", "4", "1", "e"):
        tab.keyboard.press(key)
        shown.append(seen(tab, tmp_path))
    reference, first, second, error, again, brighter = shown
    for a, b in ((reference, first), (first, second), (second, error)):
        assert np.abs(a - b).mean() > 3
    assert (again == reference).all() and brighter.mean() > reference.mean() + 5
    assert first.std() > second.std()                   # the noisier method

    def column(index: int) -> list[str]:
        return tab.locator(f"#numbers td:nth-child({index})").all_inner_texts()

    heading = tab.locator("#numbers th button").nth(2)
    for direction in ("ascending", "descending"):
        heading.focus()
        tab.keyboard.press("Enter")
        assert tab.locator("#numbers th").nth(2).get_attribute("aria-sort") == direction
        values = [float(text.split()[0]) for text in column(3)]
        assert values == sorted(values, reverse=direction == "descending") and len(set(values)) == 2
    assert column(2)[0] == "Path tracing"

    for width in (1000, 1600):
        tab.set_viewport_size({"width": width, "height": 1000})
        assert tab.evaluate("document.documentElement.scrollWidth") <= width
        for name in ("figure", "gains"):
            tab.locator(f"#{name} svg").screenshot(path=tmp_path / "seen.png")
            picture = imread(tmp_path / "seen.png")[..., :3].astype(int)
            drawn = np.abs(picture - SECOND).max(-1) < 30           # curve, dot, interval and name of the second method
            assert picture.shape[1] > 300 and 100 < drawn.sum() < 0.1 * drawn.size
    assert opened.complaints == []
    assert {request.partition(":")[0] for request in opened.requests} <= {"file", "data"}
    assert sum(request.startswith("file:") for request in opened.requests) == 1
