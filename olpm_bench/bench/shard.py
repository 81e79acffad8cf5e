"""Which cells a machine takes, where several share an experiment."""
from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from olpm_bench.bench.config import CellSpec, ConfigError


@dataclass(frozen=True)
class Shard:
    """Part `index` of `count`, from 1 to `count`: every cell is in one of them.

    Scenes and seeds are dealt out in turn, with all their methods: so that methods are compared on one machine.
    """
    index: int = 1
    count: int = 1

    @staticmethod
    def parse(text: str) -> Shard:
        """
        Raises:
            ConfigError: not "i/n" with 1 <= i <= n.
        """
        found = re.fullmatch(r"([1-9]\d*)/([1-9]\d*)", text, re.ASCII)
        if found is None or int(found[1]) > int(found[2]):
            raise ConfigError(f"--shard {text}: must be i/n, from 1/n to n/n")
        return Shard(int(found[1]), int(found[2]))

    def of(self, cells: Sequence[CellSpec]) -> list[CellSpec]:
        """The cells of this part, in their order."""
        return [spec for spec, mine in zip(cells, self._mine(cells), strict=True) if mine]

    def first(self, cells: Sequence[CellSpec]) -> list[CellSpec]:
        """All cells, those of this part first."""
        return self.of(cells) + [spec for spec, mine in zip(cells, self._mine(cells), strict=True) if not mine]

    def _mine(self, cells: Sequence[CellSpec]) -> list[bool]:
        turn = {pair: i for i, pair in enumerate(dict.fromkeys((spec.scene.name, spec.seed) for spec in cells))}
        return [turn[spec.scene.name, spec.seed] % self.count == self.index - 1 for spec in cells]

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"


WHOLE = Shard()
