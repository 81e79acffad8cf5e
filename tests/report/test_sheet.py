"""The image sheet: exact pixels, crops where methods differ, one scale for all error maps."""
from __future__ import annotations

import numpy as np
import pytest
from skimage.io import imread

from olpm_bench.bench import metrics
from olpm_bench.report import figures, sheet, tonemap

RNG = np.random.default_rng(1)


def test_crops_are_where_the_methods_differ_and_apart():
    reference = RNG.uniform(0, 1, (45, 80, 3))
    good, bad = reference + 0.1, reference + 0.1        # an error they share is no difference
    bad[10:18, 50:60] += 0.8
    bad[30:38, 5:15] += 0.4
    assert sheet.choose_crops([good, bad], reference, 10, 8) == [(50, 10), (5, 30)]


def test_a_single_method_is_cropped_where_it_is_worst():
    reference = np.zeros((45, 80, 3))
    image = reference.copy()
    image[20:28, 30:40] = 1
    first, (x, y) = sheet.choose_crops([image], reference, 10, 8)
    assert first == (30, 20) and (abs(x - 30) >= 10 or abs(y - 20) >= 8)


def test_crops_of_a_tiny_image_may_overlap():
    reference = np.zeros((2, 3, 3))
    for x, y in sheet.choose_crops([reference, reference + 1], reference, 3, 2):
        assert (x, y) == (0, 0)


@pytest.mark.parametrize(("wanted", "scale"), [(0.9, 1), (1.0, 1), (1.2, 2), (0.21, 0.5), (7, 10)])
def test_the_error_scale_is_a_round_number_above_most_errors(wanted, scale):
    assert sheet.error_scale([np.full((4, 5), wanted)]) == pytest.approx(scale)
    assert sheet.error_scale([np.full((4, 5), wanted), np.full((4, 5), np.nan)]) == pytest.approx(scale)


def test_resize_repeats_pixels_or_averages_blocks():
    image = RNG.uniform(0, 1, (9, 16, 3))
    large = sheet.resize(image, 64)
    assert large.shape == (36, 64, 3) and (large[::4, ::4] == image).all() and (large[3::4, 3::4] == image).all()
    small = sheet.resize(large, 16)
    np.testing.assert_allclose(small, image)


def test_relative_error_is_that_of_mape():
    assert sheet.relative_error(np.full((2, 2, 3), 0.3), np.full((2, 2, 3), 0.19)) == pytest.approx(0.11 / 0.20)


def test_images_stand_on_the_sheet_pixel_for_pixel(tmp_path):
    reference = RNG.uniform(0, 1, (36, 64, 3)).astype(np.float32)
    block = sheet.Block("scene", reference, None, {"A": reference * 0.9, "B": reference * 0.5})
    with figures.style():
        figure = sheet.draw([block])
        figure.savefig(tmp_path / "sheet.png", dpi=sheet.DPI)
    pixels = imread(tmp_path / "sheet.png")[..., :3]
    shown = tonemap.srgb(sheet.resize(reference), tonemap.auto_exposure(reference)).astype(int)
    h, w, _ = shown.shape
    top = round(1.9 * round(0.058 * w))
    found = pixels[top:top + h, sheet.GAP:sheet.GAP + w].astype(int)
    same = (np.abs(found - shown) <= 1).all(axis=-1)
    assert same.mean() > 0.95           # all but the outlines of the crops


def test_from_a_results_folder(finished):
    assert sheet.sheet(finished, sheet.blocks(finished)) == ["sheet.png"]
    image = imread(finished.results.folder / "sheet.png")
    assert image.shape[1] > 3 * 480 and image[..., :3].std() > 20


def test_the_seed_shown_is_the_one_with_the_median_l1(finished):
    assert sheet.median_seed(np.array([0.3, 0.1, 0.2])) == 2 and sheet.median_seed(np.array([0.3, 0.1])) == 1
    block, = sheet.blocks(finished)
    for name, cells in finished.scenes[0].cells.items():
        errors = [metrics.l1(cell.image()["mean"], block.reference) for cell in cells]
        assert block.errors[name][0] == np.median(errors)


def test_a_long_note_is_wrapped_and_not_cut_off():
    reference = RNG.uniform(0, 1, (18, 32, 3))
    with figures.style():
        block = sheet.Block("scene", reference, None, {"A": reference * 0.9})
        figure = sheet.draw([block], "; ".join(["Abacus 2, 2 threads"] * 12))
        figure.canvas.draw()
        note = next(text for text in figure.axes[0].texts if "Abacus" in text.get_text())
        box, (width, height) = note.get_window_extent(), figure.canvas.get_width_height()
    assert note.get_text().count("\n") and 0 < box.x0 < box.x1 < width and 0 < box.y0 < box.y1 < height
    others = [text.get_window_extent() for text in figure.axes[0].texts if text is not note and text.get_text()]
    assert not any(box.overlaps(other) for other in others)


def test_a_sheet_of_several_scenes_and_invalid_pixels():
    blocks = []
    for name, (h, w) in {"small": (18, 32), "square": (64, 64)}.items():
        reference = RNG.uniform(0, 1, (h, w, 3)).astype(np.float32)
        broken = reference.copy()
        broken[2, 3] = np.nan
        blocks.append(sheet.Block(name, reference, 0.001, {"A": broken, "B": reference * 0.7}))
    with figures.style():
        figure = sheet.draw(blocks, "note")
        figure.canvas.draw()
    texts = {text.get_text() for text in figure.axes[0].texts}
    assert {"small", "square", "note", "Reference", "A", "B", "L1 -"} <= texts
