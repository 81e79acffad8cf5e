"""The remedy for a misspelt name: the known name that is nearest to it."""
from __future__ import annotations

import difflib
from collections.abc import Iterable


def closest(word: str, known: Iterable[str]) -> str:
    """``"; did you mean 'x'?"``, to end a message about an unknown word with, or ``""`` where no known name is near.

    Capitals do not matter, and a dash is as good as an underscore.
    """
    names = {_plain(name): name for name in known}
    near = difflib.get_close_matches(_plain(word), names, n=1, cutoff=0.6)
    return f"; did you mean '{names[near[0]]}'?" if near else ""


def _plain(word: str) -> str:
    return word.lower().replace("-", "_")
