"""How far training is, for those who wait for it at a terminal."""
from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from olpm_bench.transport.training import PassStatistics

OnPass = Callable[["PassStatistics"], None]


@contextmanager
def training_progress(progress: bool | OnPass = True) -> Iterator[OnPass | None]:
    """What `olpm_bench.transport.training.train` calls with each pass.

    Args:
        progress: True draws a bar where standard error is a terminal; False draws none; a function is called itself.
    """
    if callable(progress):
        yield progress
        return
    if not progress or not sys.stderr.isatty():
        yield None
        return
    from olpm_bench.bench.progress import Bar

    with Bar(1.0) as bar:
        bar.at(0.0, "training: compiling")

        def show(statistics: PassStatistics) -> None:
            done = statistics.index + 1
            bar.at(done / statistics.passes, f"training pass {done} of {statistics.passes}, {statistics.records} records")

        yield show
