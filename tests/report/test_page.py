"""The page: that it stands alone, holds the numbers, and shows the pixels that are stored."""
from __future__ import annotations

import base64
import json
import re
import sys
from collections.abc import Sequence
from html.parser import HTMLParser

import numpy as np
import pytest

from olpm_bench.bench import config, metrics, run, summary
from olpm_bench.bench.finished import read
from olpm_bench.report import figures, page, sheet

pytest.importorskip("jinja2", reason="needs the extra report")
pytest.importorskip("simpleimageio", reason="needs the extra report")


def written(finished, drawn: Sequence[str] = ()) -> str:
    assert page.page(finished, summary.summarise(finished)["rows"], sheet.blocks(finished), drawn) == ["report.html"]
    return (finished.results.folder / "report.html").read_text(encoding="utf-8")


class Page(HTMLParser):
    """Identifiers, addresses and the texts of cells of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.addresses: list[str] = []
        self.cells: list[dict[str, str]] = []
        self.inside = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = {key: value or "" for key, value in attrs}
        self.inside = tag
        self.ids += [named["id"]] if "id" in named else []
        self.addresses += [named[key] for key in ("src", "href", "xlink:href", "action") if key in named]
        if tag == "td":
            self.cells.append({"value": named["data-value"], "text": ""})

    def handle_data(self, data: str) -> None:
        if self.inside == "td":
            self.cells[-1]["text"] += data.strip()


def test_the_page_stands_alone_and_its_identifiers_are_its_own(finished):
    figures.curves(finished)
    figures.gains(finished, summary.summarise(finished)["rows"])
    text = written(finished, ["figure", "gains"])
    found = Page(text)
    assert all(address.startswith(("#", "data:")) for address in found.addresses) and found.addresses
    assert len(set(found.ids)) == len(found.ids)
    assert {address[1:] for address in found.addresses if address.startswith("#")} <= set(found.ids)
    assert set(re.findall(r"url\(#([^)]*)\)", text)) <= set(found.ids)
    assert text.count('role="img"') == 2 and "Permission is hereby granted" in text


def test_the_page_holds_the_numbers_the_configuration_and_the_machine(finished):
    text = written(finished)
    rows = summary.summarise(finished)["rows"]
    cells = Page(text).cells
    assert len(cells) == len(rows) * len(page.HEADERS)
    for i, row in enumerate(rows):
        shown = dict(zip(page.HEADERS, cells[i * len(page.HEADERS):], strict=False))
        assert shown["method"]["text"] == row["method"]
        assert shown["L1"]["text"].startswith(summary.number(row["l1"]))
        assert float(shown["L1"]["value"]) == row["l1"] and float(shown["gain"]["value"]) == row["gain"]
    for piece in ("Quick &amp; dirty", "Abacus 2, 2 threads", "16 s a method, training included", "3 seeds",
                  "olpm-bench run EXPERIMENT.toml --results", "olpm-bench reference EXPERIMENT.toml", "as fast as Path tracing",
                  "checkpoints = 5"):
        assert piece in text, piece
    assert "Quick & dirty" not in text.replace("\\u0026", "&amp;")


def test_the_viewers_means_are_the_tables(finished):
    """The viewer shows (r + g + b) / 3, mean over pixels, of the data that it is given."""
    import simpleimageio

    assert re.search(r"3==\w\?\(\w\+\w\+\w\)/3", simpleimageio.make_header())
    book = page.viewers(finished, sheet.blocks(finished))[0]["data"]
    cells = finished.scenes[0].cells["Path tracing"]
    cell = cells[sheet.median_seed(finished.scenes[0].final["Path tracing"].errors["l1"])]
    shown = decoded(book, book["names"].index("Path tracing"))
    assert metrics.mean(shown) == pytest.approx(metrics.mean(cell.image()["mean"]), rel=1e-6)
    assert metrics.mean(shown) == pytest.approx(np.mean(shown.astype(np.float64).sum(axis=-1) / 3), rel=1e-12)


def test_warnings_of_training_stand_below_the_table(finished):
    assert '<ul class="caption" id="notes">' not in written(finished)
    for cell in finished.scenes[0].cells["Quick & dirty"]:
        cell.info["warnings"] = ["no camera path has met light: it may not enter <what> the camera sees"]
    text = written(finished)
    note = "<li>door_ajar / Quick &amp; dirty: no camera path has met light: it may not enter &lt;what&gt; the camera sees</li>"
    assert text.count(note) == 1 and text.index("</table>") < text.index(note) < text.index('<dl class="legend">')


def decoded(book: dict, index: int) -> np.ndarray:
    kind = {"single": np.float32, "rgbe": np.uint8}[book["types"][index]]
    raw = np.frombuffer(base64.b64decode(book["dataUrls"][index].partition(",")[2]), kind)
    return raw.reshape(book["height"], book["width"], -1)


def test_the_viewer_is_given_the_stored_pixels(finished):
    shown, = page.viewers(finished, sheet.blocks(finished))
    book = json.loads(json.dumps(shown["data"]))
    assert book["names"] == ["Reference", "Path tracing", "Quick & dirty", "error of Path tracing", "error of Quick & dirty"]
    block, = sheet.blocks(finished)
    assert (decoded(book, 0) == block.reference).all() and (decoded(book, 2) == block.images["Quick & dirty"]).all()
    error = sheet.relative_error(block.images["Path tracing"], block.reference)
    np.testing.assert_allclose(decoded(book, 3)[..., 0], error, rtol=1e-6)
    assert book["initialTMOOverrides"][:3] == [None] * 3
    assert {tmo["activeTMO"] for tmo in book["initialTMOOverrides"][3:]} == {"falsecolor"}
    assert 2 ** book["initialTMO"]["exposure"] == pytest.approx(block.exposure, rel=0.1)
    assert "of 3 seeds the one with the median L1; 32 \N{MULTIPLICATION SIGN} 18 pixels" in shown["caption"]
    floor = summary.number(finished.scenes[0].reference.noise_floor)
    assert shown["caption"].endswith(f"; reference: path, unguided, 1,300 spp, 300 s, L1 of its noise {floor}")


def test_the_commands_make_the_reference_in_as_much_time(finished):
    reference, run_ = page.commands(finished.experiment, finished.results, finished.compared)
    assert reference.startswith("olpm-bench reference ") and reference.endswith(" --seconds 300") and " run " in run_
    assert reference in written(finished)


def test_large_images_are_packed_and_then_averaged(finished, monkeypatch):
    exact, = page.viewers(finished, sheet.blocks(finished))
    pixels = 5 * 18 * 32
    for limit, kind, k in ((4 * pixels, "rgbe", 1), (3 * pixels, "rgbe", 2)):
        monkeypatch.setattr(page, "LARGEST", limit)
        shown, = page.viewers(finished, sheet.blocks(finished))
        book = shown["data"]
        assert set(book["types"]) == {kind} and (book["width"], book["height"]) == (32 // k, 18 // k)
        assert sum(decoded(book, i).nbytes for i in range(5)) <= limit
        assert ("averaged over 2 by 2" in shown["caption"]) == (k == 2)
        rgbe = decoded(book, 0).astype(np.float64)
        expected = sheet.resize(decoded(exact["data"], 0), 32 // k)
        np.testing.assert_allclose(rgbe[..., :3] * 2.0 ** (rgbe[..., 3:] - 136), expected, atol=expected.max() / 200)


def test_shared_exponents_hold_any_brightness():
    image = np.array([[[0, 0, 0], [1e-20, 2e-20, 0], [3e9, 1e9, 1], [1 - 1e-9, 0.5, 0.25]]])
    packed = page.rgbe(image).astype(np.float64)
    error = np.abs(packed[..., :3] * 2.0 ** (packed[..., 3:] - 136) - image)
    assert (error <= image.max(axis=-1, keepdims=True) / 200).all()


def test_without_reference_there_are_images_and_gains_and_no_errors(finished):
    scene = finished.experiment.scene[0].model_copy(update={"reference": config.NO_REFERENCE})
    finished = read(finished.experiment.model_copy(update={"scene": [scene]}), finished.results, {})
    text = written(finished)
    shown, = page.viewers(finished, [])
    assert shown["data"]["names"] == ["Path tracing", "Quick & dirty"] and "the first of 3 seeds" in shown["caption"]
    assert (decoded(shown["data"], 0) == finished.results.read_cell("door_ajar", "Path tracing", 0).image()["mean"]).all()
    assert "olpm-bench reference" not in text
    errors, gains = Page(text).cells[2:5], Page(text).cells[6]
    assert {cell["value"] for cell in errors} == {""} and gains["text"].startswith("1.00")


def test_what_is_missing_of_the_extra_is_said(finished, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "figuregen", None)
    monkeypatch.setattr(run, "references", lambda *arguments: {"door_ajar": finished.scenes[0].reference})
    for module, name in ((figures, "curves"), (figures, "gains"), (sheet, "sheet")):
        monkeypatch.setattr(module, name, lambda *arguments: [])
    folder = finished.results.folder.rename(finished.results.folder.with_name(finished.experiment.path.stem))
    run.report(finished.experiment, folder.parent)
    assert "report.html and crops.pdf need figuregen: pip install 'olpm-bench[report]'" in capsys.readouterr().out
    assert (folder / "report.html").is_file() and not (folder / "crops.pdf").exists()
