"""What is said on the terminal."""
from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

LONGEST = 1000              # characters of a line


def one_line(text: str) -> str:
    """What came from a file can neither steer the terminal nor fill it."""
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
    return line if len(line) <= LONGEST else f"{line[:LONGEST // 2]} ... {line[-LONGEST // 2:]}"


def plain_console(stderr: bool = False) -> Console:
    """A console that prints names as they are: ":leaves:" is no emoji, "[red]" no markup."""
    from rich.console import Console

    return Console(stderr=stderr, markup=False, emoji=False, highlight=False)
