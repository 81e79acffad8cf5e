"""What is said on the terminal."""
from __future__ import annotations

LONGEST = 1000              # characters of a line


def one_line(text: str) -> str:
    """What came from a file can neither steer the terminal nor fill it."""
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
    return line if len(line) <= LONGEST else f"{line[:LONGEST // 2]} ... {line[-LONGEST // 2:]}"
