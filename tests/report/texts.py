"""The texts of a figure, and that they can be read."""
from __future__ import annotations

import itertools

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text


def rendered(figure: Figure) -> Figure:
    """The figure as it is saved, in the style that is active."""
    figure.set_dpi(matplotlib.rcParams["savefig.dpi"])
    FigureCanvasAgg(figure).draw()
    return figure


def visible(figure: Figure) -> list[Text]:
    return [text for text in figure.findobj(Text) if text.get_text() and text.get_visible()]


def assert_readable(figure: Figure) -> None:
    """No text overlaps another or leaves the figure, which has been `rendered`."""
    boxes = [(text.get_text(), text.get_window_extent()) for text in visible(figure)]
    assert boxes
    width, height = figure.canvas.get_width_height()
    for text, box in boxes:
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= width and box.y1 <= height, f"{text!r} is cut off"
    for (text, box), (other, other_box) in itertools.combinations(boxes, 2):
        assert not box.padded(-0.5).overlaps(other_box.padded(-0.5)), f"{text!r} lies on {other!r}"
