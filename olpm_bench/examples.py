"""Examples of the commands, as their help shows them; each can be run as it stands, but for files that are yours."""
from __future__ import annotations

EXAMPLES: dict[str, tuple[str, ...]] = {
    "run": ("run quickstart --dry-run", "run quickstart", "run experiments/door_ajar.toml --scale small --with-reference",
            "run veach_ajar --scene veach_ajar=scenes/veach-ajar/scene.xml"),
    "submit": ("submit quickstart --cluster local", "submit quickstart --workers 4 --partition cpu --constraint skylake"),
    "report": ("report results/quickstart",),
    "gate": ("gate gate",),
    "reference": ("reference quickstart", "reference my.toml --seconds 3600"),
    "metrics": ("metrics results/quickstart",),
    "compare": ("compare a.exr b.exr --reference results/references/door_ajar-96x54-075c0ded",),
    "render": ("render door_ajar --method gaussian_mixture --seconds 10 --out image.exr",
               "render scene.xml --method unguided --spp 64 --out image.exr",
               "render door_ajar --set scene.gap=0.2 --method mine.py:Mine --spp 16 --out image.exr"),
    "inspect": ("inspect quickstart --pixel 48,30", "inspect results/quickstart --pixel 48,30 --method GMM"),
    "fit": ("fit --representation jensen --samples train.npz --heldout test.npz --set representation.resolution=8",),
    "check": ("check gaussian_mixture", "check mine.py:Mine --only density --only samples"),
    "perf": ("perf", "perf --scene scene.xml --width 320 --height 180"),
    "list": ("list",),
    "new": ("new experiment my_experiment", "new representation mine"),
}


FIRST = ("list", "run quickstart", "render door_ajar --method gaussian_mixture --seconds 10 --out image.exr", "run --help")


def epilog(command: str | None = None) -> str:
    """The examples of a command, or of all, for the end of its help; the first mark keeps their lines apart."""
    examples = FIRST if command is None else EXAMPLES[command]
    return "\b\nExamples:\n" + "\n".join(f"  olpm-bench {example}" for example in examples)
