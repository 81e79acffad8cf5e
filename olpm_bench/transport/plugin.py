"""The Mitsuba plugin `guided_path`, for scene files and `mi.load_dict`.

    integrator = mi.load_dict({"type": "guided_path", "representation": "gaussian_mixture", "camera_passes": 24})
    image = mi.render(scene, integrator=integrator, spp=64)

Its parameters are flat: those of `IntegratorSettings` and `TrainingSettings`, `preset`, `representation` (a name, or
"unguided"), `seed`, `progress` (false draws no bar), and the hyper-parameters of the representation.  `fraction` holds for
camera paths and particles alike.
"""
from __future__ import annotations

from typing import Any

import mitsuba as mi

import representations
from olpm_bench.training_progress import training_progress
from olpm_bench.transport import settings as options
from olpm_bench.transport.arguments import distributed, require_type
from olpm_bench.transport.path import GuidedPathIntegrator
from olpm_bench.transport.training import train

# Attributes that Mitsuba's own base classes read.
MITSUBA = {"hide_emitters", "samples_per_pass", "block_size", "timeout", "id"}


class GuidedPathPlugin(GuidedPathIntegrator):
    """Trains on the first render of a scene by a camera, and keeps the guide for further ones."""

    def __init__(self, props: mi.Properties) -> None:
        given = {name: props[name] for name in props.keys() if name not in MITSUBA}  # noqa: SIM118
        representation = given.pop("representation", "gaussian_mixture")
        self.training_seed = given.pop("seed", 0)
        self.progress = given.pop("progress", True)
        preset = given.pop("preset", "best")
        require_type("representation", representation, str, "a name")
        guided = representation != "unguided"
        integrator, training, *hyper_parameters = distributed(given, options.IntegratorSettings, options.TrainingSettings,
                                                              representation=representation if guided else None)
        if "fraction" in integrator:
            training["fraction"] = integrator["fraction"]
        self.training_settings = options.training(preset, **training)
        self.specification: dict[str, Any] | None = None
        if guided:
            self.specification = {"type": representation, **hyper_parameters[0]}
            representations.create(**self.specification)            # a wrong name or parameter is found here
        super().__init__(options.integrator(preset, **integrator), props=props)
        self.trained_for: tuple[mi.Scene, mi.Sensor] | None = None

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        view = scene, scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        if self.specification is not None and self.trained_for != view:
            with training_progress(self.progress) as on_pass:
                self.guide = train(scene, self.specification, self.training_settings, self.settings, seed=self.training_seed,
                                   sensor=view[1], on_pass=on_pass)
            self.trained_for = view
        return super().render(scene, sensor, seed, spp, develop, evaluate)


mi.register_integrator("guided_path", GuidedPathPlugin)
