"""Any scene as a ``mi.Scene`` that the harness can measure: embedded ones, and Mitsuba 3 XML files.

Whatever the scene says, its film is an RGB float32 `hdrfilm` with the box filter (with it images do not depend on
the number of threads), its sampler is `independent`, its integrator is `path`, and it has one sensor, the first.
"""
from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi

from olpm_bench import scenes
from olpm_bench.scenes import SceneError, SceneFile

VARIANTS = r"(llvm|cuda)_(ad_)?rgb"
LARGEST = 1 << 15               # pixels along a side
DEEPEST = 100                   # elements of an XML inside each other: Mitsuba's parser calls itself for each
FILM = {"pixel_format": "rgb", "component_format": "float32"}


def load(name_or_path: str | Path, parameters: dict[str, Any] | None = None, width: int | None = None,
         height: int | None = None, max_depth: int | None = None) -> mi.Scene:
    """A scene with the film, sampler and integrator described above.

    Args:
        name_or_path: an embedded scene, or the path of a Mitsuba 3 XML file.
        parameters: those of the embedded scene, or values for the file's ``<default>`` parameters.
        width, height: of the image; None: what the scene says.
        max_depth: longest path of ``scene.integrator()``, in segments, -1 for no limit; None: what the scene says,
            or else -1.

    Raises:
        SceneError: a scene that does not exist or cannot be read; one with a part that the harness cannot handle
            (participating media, `timed_sunsky`), or without sensor, emitter or shape; an unknown parameter; a value
            out of its range; a variant other than RGB on LLVM or CUDA.
    """
    check_variant()
    for key, size in (("width", width), ("height", height)):
        if size is not None:
            _check_size(key, size)
    if max_depth is not None and not (_is_integer(max_depth) and (max_depth >= 1 or max_depth == -1)):
        raise SceneError(f"max_depth = {max_depth!r}: must be an integer >= 1, or -1 for no limit")
    if scenes.is_file(name_or_path):
        return _from_file(Path(name_or_path), parameters or {}, width, height, max_depth)
    return _embedded(str(name_or_path), parameters, width, height, max_depth)


def check_variant() -> None:
    """Spectral, polarised, monochrome and scalar variants are not supported.

    Raises:
        SceneError: such a variant is in use, or none.
    """
    if not re.fullmatch(VARIANTS, mi.variant() or ""):
        raise SceneError(f"Mitsuba variant {mi.variant()!r}: must be llvm_ad_rgb or cuda_ad_rgb")


def _check_folders(folders: Iterable[Path] = ()) -> None:
    """Mitsuba looks for its plugins wherever it looks for files: in the folder of the process and in some of the scene, too.

    Raises:
        SceneError: there are some, whose code would be run.
    """
    for place in {Path.cwd(), *(folder.resolve() for folder in folders)}:
        for file in place.glob("plugins/*"):
            if file.suffix in (".so", ".dylib", ".dll"):
                raise SceneError(f"Mitsuba would run the code of {file} as a plugin; scenes are data: remove it, or go elsewhere")


def _check_size(key: str, value: Any) -> None:
    if not (_is_integer(value) and 1 <= value <= LARGEST):
        raise SceneError(f"{key} = {value!r}: must be an integer in [1, {LARGEST}] pixels")


def _is_integer(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _embedded(name: str, parameters: dict[str, Any] | None, width: int | None, height: int | None,
              max_depth: int | None) -> mi.Scene:
    _check_folders()
    scene = scenes.build(name, parameters)
    sensor = scene["sensor"]
    size = {"width": width or sensor["film"]["width"], "height": height or sensor["film"]["height"]}
    sensor["film"] = {"type": "hdrfilm", **FILM, **size, "rfilter": {"type": "box"}}
    sensor["sampler"] = {"type": "independent"}
    scene["integrator"] = {"type": "path", "max_depth": -1 if max_depth is None else max_depth}
    return mi.load_dict(scene, optimize=False)          # merges no meshes: see _from_file


def _from_file(path: Path, parameters: dict[str, Any], width: int | None, height: int | None,
               max_depth: int | None) -> mi.Scene:
    values = {k: str(v).lower() if isinstance(v, bool) else str(v) for k, v in parameters.items()}
    files, known = scenes.read(path, values)
    if (tag := files[path].root.tag) != "scene":
        raise SceneError(f"scene file {path}: its root element is <{tag}>, must be Mitsuba 3's <scene>")
    _check_text(path, files)
    for key in parameters:
        if key not in known:
            raise SceneError(f"scene file {path} has no parameter '{key}'; "
                             f"its <default> parameters: {', '.join(known) or 'none'}")
    config = mi.parser.ParserConfig(str(mi.variant()))
    config.unused_parameters = mi.LogLevel.Debug            # a <default> that nothing uses is no error
    parser: Any = mi.parser
    resolver = mi.file_resolver()  # type: ignore[operator]
    beside = mi.FileResolver(resolver)
    beside.prepend(str(path.parent))
    mi.set_file_resolver(beside)  # type: ignore[operator]
    try:
        state = parser.parse_file(config, str(path), **values)
        _check_folders(Path(str(folder)) for folder in list(beside)[:len(beside) - len(resolver)])
        _check_types(path, state)
        parser.transform_upgrade(config, state)
        parser.transform_resolve_references(config, state)
        _check_content(path, state)
        _standardise(state, width, height, max_depth)
        parser.transform_merge_equivalent(config, state)
        # Not transform_merge_meshes, as mi.load_file: it orders meshes and their emitters by addresses in memory, so that
        # images differ between processes.  It saves no time of rendering (Veach Ajar, dining-room, classroom).
        scene = parser.instantiate(config, state)
        _check_meshes(path, scene)
        return scene
    except SceneError:
        raise
    except (RuntimeError, ValueError, TypeError) as error:
        raise SceneError(f"scene file {path}: {_one_line(error)}") from error
    finally:
        mi.set_file_resolver(resolver)  # type: ignore[operator]


def _check_text(path: Path, files: dict[Path, SceneFile]) -> None:
    """Refuse what Mitsuba would hang on or crash at."""
    for file, xml in files.items():
        inside, depth = list(xml.root), 1
        while inside:
            inside, depth = [grandchild for child in inside for grandchild in child], depth + 1
        if depth > DEEPEST:
            raise SceneError(f"scene file {file}: elements inside each other {depth} deep; at most {DEEPEST}")
    for _, named, must_be_file in scenes.named_files(path, files):
        if must_be_file and named is not None and not named.is_file():
            raise SceneError(f"scene file {path}: {named} is no file")


def _check_types(path: Path, state: Any) -> None:
    """Refuse names by which Mitsuba would find code that is no plugin of its own: those that it has parsed itself."""
    for node in state.nodes:
        if re.search(r"[/\\.]", kind := node.props.plugin_name()):
            raise SceneError(f"scene file {path}: type {kind!r} is the name of no plugin")


def _check_meshes(path: Path, scene: mi.Scene) -> None:
    for shape in (shape for shape in scene.shapes() if shape.is_mesh()):
        faces, n = shape.faces_buffer().numpy(), shape.vertex_count()
        if len(faces) and faces.max() >= n:
            raise SceneError(f"scene file {path}: a face of shape '{shape.id()}' names vertex {faces.max()} of {n}")


def _check_content(path: Path, state: Any) -> None:
    """Refuse, before meshes and textures are read, what the harness cannot handle.

    A medium that only absorbs, in a file whose own integrator is `path`, is dropped with a warning: that integrator
    ignores it too.
    """
    kind = mi.ObjectType
    own = [node.props.plugin_name() for _, node in _children(state, state.root, kind.Integrator)]
    count = {kind.Sensor: 0, kind.Emitter: 0, kind.Shape: 0}
    for node in _reachable(state, state.root):
        plugin = node.props.plugin_name()
        if node.type in count:
            count[node.type] += 1
        if plugin == "timed_sunsky":
            raise SceneError(f"scene file {path}: emitter 'timed_sunsky' is not supported, for no photons can start "
                             "from it; use 'sunsky'")
        for key, medium in _children(state, node, kind.Medium) if node.type != kind.Scene else ():
            message = (f"scene file {path}: {node.type.name.lower()} '{node.props.id() or plugin}' has the "
                       f"participating medium '{medium.props.plugin_name()}'")
            if own != ["path"] or not _only_absorbs(medium):
                raise SceneError(f"{message}; only surfaces are supported")
            warnings.warn(f"{message}, which only absorbs: ignored, as the file's own integrator does", stacklevel=4)
            del node.props[key]
    for type_, found in count.items():
        if found == 0:
            raise SceneError(f"scene file {path} has no {type_.name.lower()}; a scene must have at least one")


def _only_absorbs(medium: Any) -> bool:
    albedo = medium.props.get("albedo", 1.0)
    colour = isinstance(albedo, float | int | mi.ScalarColor3d | mi.ScalarColor3f)
    return colour and all(c == 0 for c in mi.ScalarColor3f(albedo))


def _standardise(state: Any, width: int | None, height: int | None, max_depth: int | None) -> None:
    """Leave the parsed scene one sensor with our film and sampler, and make `path` its integrator."""
    kind, root = mi.ObjectType, state.root
    (sensor_key, sensor), *others = _children(state, root, kind.Sensor)
    integrators = _children(state, root, kind.Integrator)
    films = _children(state, sensor, kind.Film)
    said = films[0][1].props if films else mi.Properties()
    size = {"width": width or said.get("width", 768), "height": height or said.get("height", 576)}  # Mitsuba's defaults
    for key, value in size.items():
        _check_size(key, value)
    if max_depth is None:
        max_depth = integrators[0][1].props.get("max_depth", -1) if integrators else -1
    for key, _ in [*films, *_children(state, sensor, kind.Sampler)]:
        del sensor.props[key]
    for key, _ in [*others, *integrators]:
        del root.props[key]
    del root, sensor, others, films, integrators, said         # appending moves the nodes, which leaves these dangling
    box = _append(state, kind.ReconstructionFilter, "box")
    film = _append(state, kind.Film, "hdrfilm", **FILM, **size, standard_filter=box)
    sampler = _append(state, kind.Sampler, "independent")
    path = _append(state, kind.Integrator, "path", max_depth=max_depth)
    state.root.props["standard_integrator"] = path
    sensor_props = state.nodes[state.root.props[sensor_key].index()].props
    sensor_props["standard_film"], sensor_props["standard_sampler"] = film, sampler


def _append(state: Any, kind: mi.ObjectType, plugin: str, **properties: Any) -> Any:
    """A new node of the parsed scene; returns the reference by which its parent shall hold it."""
    node = mi.parser.SceneNode()
    node.type = kind
    node.props = mi.Properties(plugin)
    for key, value in properties.items():
        node.props[key] = value
    state.nodes.append(node)
    return mi.Properties.ResolvedReference(len(state.nodes) - 1)


def _children(state: Any, node: Any, kind: mi.ObjectType | None = None) -> list[tuple[str, Any]]:
    """(property name, node) of the objects, of one kind or all, that `node` holds or refers to."""
    keys = [k for k in node.props.keys() if node.props.type(k) == mi.Properties.Type.ResolvedReference]  # noqa: SIM118
    children = [(k, state.nodes[node.props[k].index()]) for k in keys]
    return [(k, child) for k, child in children if kind is None or child.type == kind]


def _reachable(state: Any, node: Any) -> Iterator[Any]:
    yield node
    for _, child in _children(state, node):
        yield from _reachable(state, child)


def _one_line(error: Exception) -> str:
    """Mitsuba's message without its source positions and line breaks."""
    return " ".join(re.sub(r"\[\w+\.cpp:\d+\]\s*", "", str(error)).split())
