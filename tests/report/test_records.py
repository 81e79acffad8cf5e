"""The picture of the records over the image."""
from __future__ import annotations

import numpy as np
from skimage.io import imread

from olpm_bench.report import figures, records
from olpm_bench.transport.view import RecordView


def _view() -> tuple[RecordView, np.ndarray]:
    record = np.repeat(np.arange(-1, 3), 8).reshape(4, 8)
    radius, count = np.array([0.1, 0.5, 1, np.nan])[record], np.array([10, 100, 1000, 0])[record]
    return RecordView(np.ones((4, 8), bool), record, radius, count), np.random.default_rng(0).uniform(0, 1, (4, 8, 3))


def test_cells_have_colours_of_their_own():
    view, _ = _view()
    shown = records.cells(view.record, np.full((4, 8, 3), 0.5))
    assert len(np.unique(shown.reshape(-1, 3).round(6), axis=0)) == 4
    assert np.ptp(shown[0], axis=0).max() == 0 and np.ptp(shown[0, 0]) < 1e-9          # grey without a record


def test_titles_state_the_shares():
    view, image = _view()
    with figures.style():
        titles = [axes.get_title() for axes in records.draw(view, image, 80).axes[:3]]
    assert titles[0] == "records: 3 seen, serving 75.0% of the pixels"
    assert titles[2] == "particles seen; 50.0% of the pixels have 80 or more"


def test_the_share_that_guides_is_of_surfaces_that_can_be_guided_from():
    view, _ = _view()
    assert view.guided == 0.5
    view.surface[:1] = False                # a row without record
    assert view.guided == 2 / 3
    view.surface[:] = False
    assert view.guided == 1


def test_the_picture_is_written_with_its_marks(tmp_path):
    records.records_map(*_view(), 80, tmp_path / "map.png")
    records.records_map(*_view(), 80, tmp_path / "marked.png", marks=[(6, 2)])
    plain, marked = imread(tmp_path / "map.png"), imread(tmp_path / "marked.png")
    changed = np.flatnonzero((plain != marked).any(2).any(0))           # columns: around the pixel in all three panels
    assert 2 < len(np.flatnonzero(np.diff(changed) > 50)) + 1 <= 3 and plain.ndim == 3


def test_a_guide_without_records_can_be_shown(tmp_path):
    empty = RecordView(np.ones((4, 8), bool), np.full((4, 8), -1), np.full((4, 8), np.nan), np.zeros((4, 8)))
    records.records_map(empty, np.zeros((4, 8, 3)), 80, tmp_path / "map.pdf")
    assert (tmp_path / "map.pdf").is_file()
