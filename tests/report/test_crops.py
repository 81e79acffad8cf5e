"""The crop figure: one page of the pixels of the crops, with the boxes that the experiment's file names."""
from __future__ import annotations

import dataclasses
import importlib.util

import numpy as np
import pytest
from skimage.io import imread

from olpm_bench.bench import summary
from olpm_bench.report import crops, sheet, tonemap

if importlib.util.find_spec("figuregen") is None:         # not imported here: it would change the style of all plots
    pytest.skip("needs the extra report", allow_module_level=True)
pytest.importorskip("typst", reason="needs the extra report")

RNG = np.random.default_rng(1)
BOXES = [(2, 3, 8, 6), (20, 10, 8, 6)]


def block(name: str = "scene", methods: tuple[str, ...] = ("A", "B"), given: list[sheet.Crop] | None = None) -> sheet.Block:
    reference = RNG.uniform(0.1, 1, (18, 32, 3)).astype(np.float32)
    images = {method: reference * (1 + 0.1 * i) for i, method in enumerate(methods)}
    return sheet.Block(name, reference, 0.001, images, BOXES if given is None else given)


def colour(box: str) -> list[int]:
    return list(bytes.fromhex(box[1:]))


def test_a_vector_page_and_its_picture(tmp_path):
    crops.draw([block()], "A note.", tmp_path)
    assert (tmp_path / "crops.pdf").read_bytes().startswith(b"%PDF")
    picture = imread(tmp_path / "crops.png")[..., :3]
    height, width, _ = picture.shape
    assert width == pytest.approx((crops.WIDTH + 2) / 25.4 * crops.DPI, abs=2) and 0.1 * width < height < 0.5 * width
    boxed = [(picture == colour(box)).all(axis=-1).sum() for box in sheet.BOXES]
    assert min(boxed[:2]) > 500 and boxed[2:] == [0, 0]


def test_insets_show_the_pixels_of_the_crop(tmp_path):
    shown = block(methods=("A",), given=[(4, 6, 2, 2)])
    crops.draw([shown], "", tmp_path)
    picture = imread(tmp_path / "crops.png")[..., :3].astype(int)
    red = (picture == colour(sheet.BOXES[0])).all(axis=-1)
    columns = np.flatnonzero(red.sum(axis=0) > 0.3 * red.sum(axis=0).max())
    right = columns[columns > 0.8 * picture.shape[1]]           # the frame of the inset of the last column
    rows = np.flatnonzero(red[:, right[0]])
    left, top = columns[columns < right[0] - 100][-1], rows[0]
    for y in range(2):
        for x in range(2):
            seen = picture[round(top + (rows[-1] - top) * (0.25 + 0.5 * y)), round(left + (right[0] - left) * (0.25 + 0.5 * x))]
            expected = tonemap.srgb(shown.images["A"], shown.exposure)[6 + y, 4 + x].astype(int)
            assert np.abs(seen - expected).max() <= 2


def test_the_number_under_an_inset_is_the_error_of_what_it_shows():
    """And those at the foot of a column are of the whole image, and say so."""
    shown = block()
    _, insets = crops._grids(shown, "")
    for row, (x, y, width, height) in enumerate(BOXES):
        captions = [insets[row, column].elem["captions"]["south"] for column in range(3)]
        errors = [np.abs(image - shown.reference)[y:y + height, x:x + width].mean() for image in shown.images.values()]
        assert captions == ["", *(f"L1 {summary.number(error)}" for error in errors)]
    noise, *whole = insets.data["column_titles"]["south"]["content"]
    assert noise == r"whole image:\\noise floor\\0.00100"
    assert whole == [rf"whole image:\\L1 {summary.number(l1)}\\relMSE {summary.number(relmse)}"
                     for l1, relmse in shown.errors.values()]


def test_awkward_names_scenes_and_notes_are_set(tmp_path):
    names = ('A "quoted" \\ name that is far too long for its column', "#x $y *z* é–λ", "C", "D", "E", "F")
    crops.draw([block("first", names), block("second", names, BOXES[:1])], 'Note: "#[x] \\ é', tmp_path)
    assert imread(tmp_path / "crops.png").shape[0] > 500
    assert sorted(path.name for path in tmp_path.iterdir()) == ["crops.pdf", "crops.png"]


def test_from_a_results_folder(finished):
    scene, pictures = finished.scenes[0], []
    boxed = dataclasses.replace(scene, scene=scene.scene.model_copy(update={"crops": BOXES}))
    for found in (finished, dataclasses.replace(finished, scenes=[boxed])):
        assert crops.crops(found, sheet.blocks(found)) == ["crops.pdf", "crops.png"]
        pictures.append(imread(finished.results.folder / "crops.png")[..., :3])
        assert pictures[-1].std() > 20
    assert not np.array_equal(*pictures)
