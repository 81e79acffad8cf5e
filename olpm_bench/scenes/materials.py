"""BSDFs of the embedded scenes, as dictionaries for ``mi.load_dict``.

A colour is a triple of linear RGB reflectances or a texture (:func:`olpm_bench.scenes.textures.texture`).
"""
from __future__ import annotations

from typing import Any

Colour = tuple[float, float, float] | dict[str, Any]


def diffuse(reflectance: Colour) -> dict[str, Any]:
    """Lambert, on both sides."""
    return _two_sided(type="diffuse", reflectance=_value(reflectance))


def plastic(reflectance: Colour, alpha: float) -> dict[str, Any]:
    """Diffuse under a varnish of GGX roughness `alpha`, on both sides."""
    return _two_sided(type="roughplastic", distribution="ggx", alpha=alpha, int_ior=1.5,
                      diffuse_reflectance=_value(reflectance))


def metal(material: str, alpha: float) -> dict[str, Any]:
    """One of Mitsuba's conductors, of GGX roughness `alpha`, on both sides."""
    return _two_sided(type="roughconductor", distribution="ggx", alpha=alpha, material=material)


def glass() -> dict[str, Any]:
    """Clear and smooth, index 1.5: of closed bodies."""
    return {"type": "dielectric", "int_ior": 1.5}


def _two_sided(**bsdf: Any) -> dict[str, Any]:
    return {"type": "twosided", "bsdf": bsdf}


def _value(colour: Colour) -> dict[str, Any]:
    return {"type": "rgb", "value": list(colour)} if isinstance(colour, tuple) else colour
