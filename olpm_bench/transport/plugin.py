"""The Mitsuba plugin `guided_path`, for scene files and `mi.load_dict`.

    integrator = mi.load_dict({"type": "guided_path", "representation": "gaussian_mixture", "camera_passes": 24})
    image = mi.render(scene, integrator=integrator, spp=64)

Its parameters are flat: those of `IntegratorSettings` and `TrainingSettings`, `preset`, `representation` (a name, or
"unguided"), `seed`, and the hyper-parameters of the representation.  `fraction` holds for camera paths and particles alike.
"""
from __future__ import annotations

import dataclasses
from typing import Any

import mitsuba as mi

import representations
from olpm_bench.transport import settings as options
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
        integrator, training = ({f.name: given[f.name] for f in dataclasses.fields(cls) if f.name in given}
                                for cls in (options.IntegratorSettings, options.TrainingSettings))
        preset = given.pop("preset", "best")
        self.training_settings = options.training(preset, **training)
        hyper_parameters = {k: v for k, v in given.items() if k not in integrator and k not in training}
        self.specification: dict[str, Any] | None = None
        if representation != "unguided":
            self.specification = {"type": representation, **hyper_parameters}
            representations.create(**self.specification)            # a wrong name or parameter is found here
        super().__init__(options.integrator(preset, **integrator), props=props)
        self.trained_for: tuple[mi.Scene, mi.Sensor] | None = None

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        view = scene, scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        if self.specification is not None and self.trained_for != view:
            self.guide = train(scene, self.specification, self.training_settings, self.settings, seed=self.training_seed,
                               sensor=view[1])
            self.trained_for = view
        return super().render(scene, sensor, seed, spp, develop, evaluate)


mi.register_integrator("guided_path", GuidedPathPlugin)
