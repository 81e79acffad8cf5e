"""olpm-bench: one guided path tracer for Mitsuba 3, and what it takes to measure which guide is best.

As a library, imported before `mitsuba` and `drjit` so that these find a libLLVM that works, and after `mi.set_variant`:

    scene = olpm_bench.load_scene("scene.xml")
    guide = olpm_bench.train(scene, "gaussian_mixture", components=8, camera_passes=24)
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

    from olpm_bench.training_progress import OnPass
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


def load_scene(path: str | Path, parameters: dict[str, Any] | None = None, *, width: int | None = None,
               height: int | None = None, max_depth: int | None = None) -> mi.Scene:
    """An embedded scene, or a Mitsuba XML file with a box filter and without merged meshes, in which guides can be trained.

    Args:
        path: of the file, or the name of an embedded scene.
        parameters: values for the file's ``<default>`` parameters, or the embedded scene's parameters.
        width, height, max_depth: of the image [pixels], and of ``scene.integrator()``; what the scene says by default.

    Raises:
        SceneError: it cannot be used; the message says why.
    """
    register()
    from olpm_bench.scenes import load
    from olpm_bench.transport.arguments import require_type
    require_type("path", path, (str, Path), "the path of a file, or a name")
    return load.load(path, parameters, width, height, max_depth)


def load_guide(path: str | Path, representation: str | None = None) -> Guide:
    """A guide that ``guide.save(path)`` has written.

    Args:
        representation: the type that it must be of.  FILE.py:Class, whose code is then run, must be given.

    Raises:
        InputError: it is no whole guide file, or of another version or type.
        OSError: it can't be read.
    """
    register()
    from olpm_bench.transport.arguments import require_type
    from olpm_bench.transport.guide import Guide
    require_type("path", path, (str, Path), "the path of a file")
    return Guide.load(path, representation)


def train(scene: mi.Scene, representation: str | dict[str, Any] = "gaussian_mixture", *, max_depth: int = 13, seed: int = 0,
          preset: str = "best", integrator: dict[str, Any] | None = None, sensor: mi.Sensor | None = None,
          progress: bool | OnPass = True, **settings: Any) -> Guide:
    """Train a guide on a scene.

    Args:
        representation: a registered name, or ``{"type": name, ...hyper-parameters}``.
        max_depth: of the camera paths to be guided [segments].
        preset, settings: of `olpm_bench.transport.settings.TrainingSettings`: passes, photons, importons, gather, ..., and the
            hyper-parameters of the representation: components, ...  All passes are done: `share`, `blend` and
            `while_rendering` concern the budgets of `olpm-bench run` only.
        integrator: of `IntegratorSettings`, for the passes of camera paths: roulette, fraction, ...
        sensor: the camera from which importons and camera paths start, and whose pixels the roulette weighs paths for; the
            scene's first by default.  The guide is right for others, too, but not made for them.
        progress: True draws a bar where standard error is a terminal, False none; or a function that is called with the
            `PassStatistics` of each pass.

    Returns:
        A guide, which can be saved, loaded by :func:`load_guide` and handed to :func:`integrator`.

    Raises:
        InputError: a setting that is not known or out of its range, or a scene that can't be guided in.
        RepresentationError: there is no such representation, or a hyper-parameter has a wrong value.
    """
    register()
    import mitsuba as mi

    from olpm_bench.training_progress import training_progress
    from olpm_bench.transport import settings as options
    from olpm_bench.transport import training
    from olpm_bench.transport.arguments import distributed, require_type
    require_type("scene", scene, mi.Scene, "a Mitsuba scene, as of olpm_bench.load_scene(path)")
    require_type("representation", representation, (str, dict), "a name, or {'type': name, ...}")
    require_type("sensor", sensor, (mi.Sensor, type(None)), "one of the scene's sensors")
    specification = {"type": representation} if isinstance(representation, str) else dict(representation)
    require_type("representation's type", specification.get("type"), str, "a name")
    require_type("preset", preset, str, "a name")
    require_type("seed", seed, int, "a whole number")
    own, hyper_parameters = distributed(settings, options.TrainingSettings, representation=specification["type"])
    of_paths, = distributed({"max_depth": max_depth} | (integrator or {}), options.IntegratorSettings)
    with training_progress(progress) as on_pass:
        return training.train(scene, specification | hyper_parameters, options.training(preset, **own),
                              options.integrator(preset, **of_paths), seed=seed, sensor=sensor, on_pass=on_pass)


def integrator(guide: Guide | str | Path | None = None, preset: str = "best", **settings: Any) -> GuidedPathIntegrator:
    """A path tracer with a guide, or an unguided one.

    Args:
        guide: as :func:`train` returns it, or the file of one.
        preset: the one that the guide was trained with brings its roulette.
        settings: of `olpm_bench.transport.settings.IntegratorSettings`: max_depth, roulette, rr_depth, window, fraction.

    Raises:
        InputError: a setting that is not known or out of its range, or a file that holds no guide.
        OSError: the file can't be read.
    """
    register()
    from olpm_bench.transport.arguments import distributed, require_type
    from olpm_bench.transport.guide import Guide
    from olpm_bench.transport.path import GuidedPathIntegrator
    from olpm_bench.transport.settings import IntegratorSettings
    from olpm_bench.transport.settings import integrator as of_preset
    require_type("guide", guide, (Guide, str, Path, type(None)), "a guide, the file of one, or None")
    require_type("preset", preset, str, "a name")
    own, = distributed(settings, IntegratorSettings)
    loaded = load_guide(guide) if isinstance(guide, str | Path) else guide
    return GuidedPathIntegrator(of_preset(preset, **own), loaded)
