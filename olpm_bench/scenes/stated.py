"""What a scene file says of its image, and what the harness makes of it."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi

from olpm_bench.scenes import SceneError

WIDTH, HEIGHT = 768, 576            # of Mitsuba's films that do not say it [pixels]
ONE_PIXEL = ("radiancemeter", "irradiancemeter", "distant")         # sensors that Mitsuba makes with such films only
# Longest path of integrators whose file does not say it; that of all others has no limit.
MAX_DEPTH = {"direct": 2, "direct_projective": 2, "prb": 6, "prb_basic": 6, "prb_projective": 6}
CROP = ("crop_offset_x", "crop_offset_y", "crop_width", "crop_height")


@dataclass(frozen=True)
class Stated:
    """What a scene file says of its image, or else Mitsuba's defaults.

    width, height: of the image, which is that of the crop window if there is one [pixels].
    film: width and height of the film.
    offset: of the image on the film, (x, y).
    max_depth: longest path in segments, -1 for no limit.
    hide_emitters: emitters that the camera sees directly are black.
    spp: samples a pixel; None: not said.
    sensor: its type.
    shapes: how many there are.
    replaced: (what the harness has, what the file says) of all that it replaces.
    """
    width: int
    height: int
    film: tuple[int, int]
    offset: tuple[int, int]
    max_depth: int
    hide_emitters: bool
    spp: int | None
    sensor: str
    shapes: int
    replaced: list[tuple[str, str]] = field(default_factory=list)

    def window(self, width: int, height: int) -> dict[str, int]:
        """Properties of a film whose image is the file's, in another size; the crop window is rounded to its pixels.

        Raises:
            SceneError: the sensor cannot have an image of this size.
        """
        if self.sensor in ONE_PIXEL and (width, height) != (1, 1):
            raise SceneError(f"sensor '{self.sensor}' has an image of 1 x 1 pixels, and not of {width} x {height}")
        if self.film == (self.width, self.height):
            return {"width": width, "height": height}
        properties = {}
        for axis, size, own, film, offset in zip("xy", (width, height), (self.width, self.height), self.film, self.offset,
                                                 strict=True):
            whole = max(round(film * size / own), size)
            properties["width" if axis == "x" else "height"] = whole
            properties["crop_width" if axis == "x" else "crop_height"] = size
            properties[f"crop_offset_{axis}"] = min(round(offset * size / own), whole - size)
        return properties

    def differences(self, width: int, height: int, max_depth: int) -> str | None:
        """In one line, what an image is made of and not as the file says; None: nothing."""
        found = list(self.replaced)
        if (width, height) != (self.width, self.height):
            found.insert(0, (f"{width} x {height} pixels", f"{self.width} x {self.height}"))
        if max_depth != self.max_depth:
            found.insert(0, (f"max_depth {max_depth}", str(self.max_depth)))
        return ", ".join(f"{ours} (the file says {theirs})" for ours, theirs in found) or None


def children(state: Any, node: Any, kind: mi.ObjectType | None = None) -> list[tuple[str, Any]]:
    """(property name, node) of the objects, of one kind or all, that `node` holds or refers to."""
    keys = [k for k in node.props.keys() if node.props.type(k) == mi.Properties.Type.ResolvedReference]  # noqa: SIM118
    found = [(k, state.nodes[node.props[k].index()]) for k in keys]
    return [(k, child) for k, child in found if kind is None or child.type == kind]


def sensors(state: Any) -> list[tuple[Any, str, Any]]:
    """(node that holds it, property name, node) of each sensor: those of the scene first, then those of shapes."""
    kind = mi.ObjectType
    held = [(state.root, key, node) for key, node in children(state, state.root, kind.Sensor)]
    if sum(node.type == kind.Sensor for node in state.nodes) > len(held):
        held += [(shape, key, node) for shape in state.nodes if shape.type == kind.Shape
                 for key, node in children(state, shape, kind.Sensor)]
    return held


def integrators(state: Any) -> Iterator[Any]:
    """The scene's integrator, the first that it holds, and so on: `aov` holds the one that traces paths."""
    found = children(state, state.root, mi.ObjectType.Integrator)
    while found:
        yield found[0][1]
        found = children(state, found[0][1], mi.ObjectType.Integrator)


def stated(state: Any) -> Stated:
    """What a parsed file says, whose references are resolved and which has a sensor.

    Raises:
        SceneError: a value of a wrong type, or a crop window without pixels.
    """
    kind = mi.ObjectType
    found = sensors(state)
    sensor = found[0][2]
    plugin = sensor.props.plugin_name()
    films, samplers = children(state, sensor, kind.Film), children(state, sensor, kind.Sampler)
    film = films[0][1] if films else None
    props = film.props if film is not None else mi.Properties()
    one = plugin in ONE_PIXEL
    size = _whole(props, "width", 1 if one else WIDTH), _whole(props, "height", 1 if one else HEIGHT)
    x, y, width, height = (_whole(props, key, default) for key, default in zip(CROP, (0, 0, *size), strict=True))
    cropped = (x, y, width, height) != (0, 0, *size)
    if cropped and not (0 <= x < x + width <= size[0] and 0 <= y < y + height <= size[1]):
        raise SceneError(f"its crop window, {width} x {height} pixels from ({x}, {y}) on, is not inside its film of "
                         f"{size[0]} x {size[1]}")
    tracers = [node.props for node in integrators(state)]
    depth = MAX_DEPTH.get(tracers[-1].plugin_name(), -1) if tracers else -1
    spp = _whole(samplers[0][1].props, "sample_count", 0) if samplers else 0
    return Stated(width, height, size, (x, y), _first(tracers, "max_depth", depth), _first(tracers, "hide_emitters", False),
                  spp if spp > 0 else None, plugin, sum(node.type == kind.Shape for node in state.nodes),
                  _replaced(state, film, samplers, tracers, len(found)))


def _replaced(state: Any, film: Any, samplers: list[tuple[str, Any]], tracers: list[Any], n_sensors: int,
              ) -> list[tuple[str, str]]:
    found = []
    if film is not None:
        filters = children(state, film, mi.ObjectType.ReconstructionFilter)
        pixel_format = str(film.props.get("pixel_format", "rgb"))
        found += [("a box filter", node.props.plugin_name()) for _, node in filters[:1]]
        found += [("an RGB image", film.props.plugin_name() if film.props.plugin_name() != "hdrfilm" else pixel_format)]
    found += [("independent samples", node.props.plugin_name()) for _, node in samplers[:1]]
    found += [("a path tracer", props.plugin_name()) for props in tracers[:1]]
    found += [("the first sensor alone", f"{n_sensors} of them")] if n_sensors > 1 else []
    same = {"box", "rgb", "RGB", "independent", "path"}
    return [(ours, theirs) for ours, theirs in found if theirs not in same]


def _whole(props: Any, key: str, default: int) -> int:
    value = props.get(key, default)
    if not isinstance(value, int) or isinstance(value, bool):
        raise SceneError(f"{key} = {value!r}: must be a whole number")
    return value


def _first(tracers: list[Any], key: str, default: Any) -> Any:
    """The value of the outermost integrator that says it."""
    value = next((props[key] for props in tracers if key in props), default)
    if type(value) is not type(default):
        raise SceneError(f"{key} = {value!r}: must be {'true or false' if isinstance(default, bool) else 'a whole number'}")
    return value
