"""olpm-bench: one guided path tracer for Mitsuba 3, and what it takes to measure which guide is best.

As a library, imported before `mitsuba` and `drjit` so that these find a libLLVM that works, and after `mi.set_variant`:

    guide = olpm_bench.train(scene, "gaussian_mixture", camera_passes=24)
    image = mi.render(scene, integrator=olpm_bench.integrator(guide, max_depth=13), spp=64)

or `olpm_bench.register()`, and then the Mitsuba plugin `guided_path`.
"""
from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

try:
    import representations  # noqa: F401  (points Dr.Jit at a libLLVM that works, before the first `import drjit`)
except ImportError as error:
    # Our command line, a module of this package, could not catch it; whoever imports us as a library can.
    called = Path(sys.argv[0]).stem == "olpm-bench" or "olpm_bench.cli" in sys.orig_argv
    if not called or type(error).__name__ != "LLVMError":
        raise
    print(f"olpm-bench: {error}", file=sys.stderr)
    raise SystemExit(2) from None

if TYPE_CHECKING:
    import mitsuba as mi

    from olpm_bench.transport.guide import Guide
    from olpm_bench.transport.path import GuidedPathIntegrator

_registered: str | None = None      # the variant whose classes our integrators were made from


def register() -> None:
    """Make the Mitsuba plugin `guided_path`; call it after `mi.set_variant`, and again after a change of variant.

    Raises:
        InputError: the variant is not one in which guiding works.
    """
    global _registered
    import mitsuba as mi
    variant = mi.variant()
    if variant not in ("llvm_ad_rgb", "cuda_ad_rgb"):
        from olpm_bench.transport.settings import InputError
        raise InputError(f"Mitsuba variant '{variant}': guiding needs llvm_ad_rgb or cuda_ad_rgb; call mi.set_variant first")
    for name in ("olpm_bench.transport.path", "olpm_bench.transport.plugin"):
        if name in sys.modules and _registered not in (None, variant):
            importlib.reload(sys.modules[name])         # the base class belongs to a variant
        importlib.import_module(name)
    _registered = variant


def train(scene: mi.Scene, representation: str | dict[str, Any] = "gaussian_mixture", *, max_depth: int = 13, seed: int = 0,
          preset: str = "best", integrator: dict[str, Any] | None = None, sensor: mi.Sensor | None = None,
          **settings: Any) -> Guide:
    """Train a guide on a scene.

    Args:
        representation: a registered name, or ``{"type": name, ...hyper-parameters}``.
        max_depth: of the camera paths to be guided [segments].
        preset, settings: of `olpm_bench.transport.settings.TrainingSettings`: passes, photons, importons, gather, ...  All passes
            are done: `share`, `blend` and `while_rendering` concern the budgets of `olpm-bench run` only.
        integrator: of `IntegratorSettings`, for the passes of camera paths: roulette, fraction, ...
        sensor: the camera from which importons and camera paths start, and whose pixels the roulette weighs paths for; the
            scene's first by default.  The guide is right for others, too, but not made for them.

    Returns:
        A guide, which can be saved, loaded (`olpm_bench.transport.guide.Guide.load`) and handed to :func:`integrator`.
    """
    register()
    from olpm_bench.transport import settings as options
    from olpm_bench.transport import training
    return training.train(scene, representation, options.training(preset, **settings),
                          options.integrator(preset, max_depth=max_depth, **integrator or {}), seed=seed, sensor=sensor)


def integrator(guide: Guide | None = None, preset: str = "best", **settings: Any) -> GuidedPathIntegrator:
    """A path tracer with a guide, or an unguided one.

    Args:
        preset: the one that the guide was trained with brings its roulette.
        settings: of `olpm_bench.transport.settings.IntegratorSettings`: max_depth, roulette, rr_depth, window, fraction.
    """
    register()
    from olpm_bench.transport.path import GuidedPathIntegrator
    from olpm_bench.transport.settings import integrator as of_preset
    return GuidedPathIntegrator(of_preset(preset, **settings), guide)
