"""The crop figure, as papers have it: the reference with boxes drawn, and what each method makes of them.

Laid out by figuregen, set by Typst; text and boxes are vectors, pixels are shown as they are.  Both are in the extra `report`.
"""
from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from olpm_bench.bench import metrics, summary
from olpm_bench.bench.files import replacing
from olpm_bench.report import figures, sheet, tonemap

if TYPE_CHECKING:
    from olpm_bench.bench.finished import Finished

WIDTH = 178.0                   # of two columns of a paper [mm]
DPI = 300                       # of the PNG
FONT = "STIXGeneral"            # of all figures; comes with Matplotlib
SIZE = 8.0                      # of text [pt], where there is room
LINE = 3.4                      # height of a line of text [mm]
STROKE = 1.2                    # of boxes [pt]
WHOLE = "whole image:"
NEW_LINE = r"\\"                 # as figuregen has it
PAGE = """#set page(width: auto, height: auto, margin: 1mm)
#set text(font: "{font}")
#set image(scaling: "pixelated")
"""
NOTE = '#v(1mm, weak: true)#block(width: {width}mm, text(size: 6.5pt, fill: rgb("#555555"), "{note}"))\n'


def crops(found: Finished, blocks: Sequence[sheet.Block]) -> list[str]:
    """Write crops.pdf and crops.png into the results folder, if there is something to show; return their names.

    Raises:
        ImportError: figuregen or Typst is not installed.
    """
    if not blocks:
        return []
    draw(blocks, sheet.caption(found), found.results.folder)
    return ["crops.pdf", "crops.png"]


def draw(blocks: Sequence[sheet.Block], note: str, folder: Path) -> None:
    """Write crops.pdf and crops.png into `folder`: one row a scene, `note` below."""
    import matplotlib
    import typst

    figuregen = _figuregen()
    from figuregen.typst import TypstBackend

    class Page(TypstBackend):
        """A page as large as the figure, with its note."""

        def write_to_file(self, data: str, filename: str) -> None:
            text = PAGE.format(font=FONT) + self.header + data + NOTE.format(width=WIDTH, note=_quoted(note))
            Path(filename).write_text(text, encoding="utf-8")

    page, rows = Page(), [_grids(block, title=block.scene if len(blocks) > 1 else "") for block in blocks]
    for row in rows:
        _fit_text(page, row)
    fonts = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    with tempfile.TemporaryDirectory() as temporary:
        source = Path(temporary) / "crops.typ"
        figuregen.figure(rows, WIDTH / 10, str(source), page)
        with replacing(folder / "crops.pdf") as beside:
            typst.compile(source, output=beside, format="pdf", font_paths=[fonts])
        with replacing(folder / "crops.png") as beside:
            typst.compile(source, output=beside, format="png", ppi=DPI, font_paths=[fonts])


def _figuregen() -> Any:
    """The library, without the style and the LaTeX backend that its import sets for all plots of the process."""
    import matplotlib

    backend = matplotlib.get_backend()
    with matplotlib.rc_context():
        import figuregen
    matplotlib.use(backend)
    return figuregen


def _grids(block: sheet.Block, title: str) -> list[Any]:
    """The two grids of a scene: the reference with boxes, and the insets, a column for the reference and each method.

    Under each inset stands its own error, at the foot of a column those of the whole image.
    """
    figuregen = _figuregen()
    images = {"Reference": block.reference, **block.images}
    whole, insets = figuregen.Grid(1, 1), figuregen.Grid(len(block.crops), len(images))
    whole[0, 0].image = _png(block.reference, block.exposure)
    for row, (x, y, width, height) in enumerate(block.crops):
        colour = list(bytes.fromhex(sheet.BOXES[row][1:]))
        whole[0, 0].set_marker((x, y), (width, height), colour, linewidth_pt=STROKE)
        for column, image in enumerate(images.values()):
            shown, truth = (pixels[y:y + height, x:x + width] for pixels in (image, block.reference))
            insets[row, column].image = _png(shown, block.exposure)
            insets[row, column].set_frame(STROKE, colour)
            insets[row, column].set_caption(f"L1 {summary.number(metrics.l1(shown, truth))}" if column else "")
    errors = [NEW_LINE.join((WHOLE, f"L1 {summary.number(l1)}", f"relMSE {summary.number(relmse)}"))
              for l1, relmse in block.errors.values()]
    noise = "" if block.floor is None else NEW_LINE.join((WHOLE, "noise floor", summary.number(block.floor)))
    whole[0, 0].set_caption("")
    for grid, above, below in ((whole, [title], [""]), (insets, list(images), [noise, *errors])):
        for side, texts, lines in (("north", above, 1), ("south", below, 3)):
            grid.set_col_titles(side, [text.replace('"', "\N{RIGHT DOUBLE QUOTATION MARK}") for text in texts])
            grid.layout.column_titles[side].size, grid.layout.column_titles[side].offset = lines * LINE, 0.4
        grid.layout.captions["south"].size, grid.layout.captions["south"].offset = LINE, 0.4
    insets.layout.padding["west"] = 1.0
    return [whole, insets]


def _png(image: np.ndarray, exposure: float) -> Any:
    return _figuregen().PNG(tonemap.srgb(image, exposure).astype(np.float32) / 255)


def _fit_text(page: Any, row: Sequence[Any]) -> None:
    """Two lines for the names above insets where one is too short, and smaller text where that does not do, either.

    Args:
        page: the backend, which knows how wide an inset will be; row: the two grids of a scene.
    """
    def room() -> float:
        return 0.95 * float(page.compute_aligned_sizes(row, WIDTH)[1][1].width_mm)

    def widest(texts: Iterable[str]) -> float:
        return max(25.4 * figures.text_width(text, SIZE) for text in texts if text)

    names, errors = (row[1].data["column_titles"][side]["content"] for side in ("north", "south"))
    wanted = widest(names)
    if wanted > room():
        for grid in row:
            grid.layout.column_titles["north"].size = 2 * LINE
        wanted = max(0.6 * wanted, widest(word for name in names for word in name.split()))
    below = widest(line for text in errors for line in text.split(NEW_LINE))
    layout = row[1].layout
    for text, width in ((layout.column_titles["north"], wanted), (layout.column_titles["south"], below),
                        (layout.captions["south"], below)):
        text.fontsize = SIZE * min(1.0, room() / width)


def _quoted(text: str) -> str:
    """As it stands in a string of Typst."""
    return text.replace("\\", "\\\\").replace('"', '\\"')
