"""Any scene as a ``mi.Scene`` that the harness can measure: embedded ones, and Mitsuba 3 XML files.

Whatever the scene says, its film is an RGB float32 `hdrfilm` with the box filter (with it images do not depend on
the number of threads), its sampler is `independent`, its integrator is `path`, and it has one sensor, the first.  The size of
the image, its crop window, `max_depth` and `hide_emitters` are those of the file; `Parsed.stated` tells what is not.
"""
from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mitsuba as mi

from olpm_bench import scenes
from olpm_bench.scenes import SceneError, SceneFile
from olpm_bench.scenes.stated import children, sensors, stated
from olpm_bench.suggest import closest

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
        return Parsed(Path(name_or_path), parameters).build(width, height, max_depth)
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
    return mi.load_dict(scene, optimize=False)          # merges no meshes: see Parsed.build


class Parsed:
    """A scene file that has been parsed and checked, as far as this can be done before meshes and images are read.

    Attributes:
        stated: what it says of its image.
    """

    def __init__(self, path: Path, parameters: dict[str, Any] | None = None) -> None:
        """
        Raises:
            SceneError: as `load`.
        """
        self.path = path
        values = {k: str(v).lower() if isinstance(v, bool) else str(v) for k, v in (parameters or {}).items()}
        files, known = scenes.read(path, values)
        if (tag := files[path].root.tag) != "scene":
            raise SceneError(f"scene file {path}: its root element is <{tag}>, must be Mitsuba 3's <scene>")
        _check_text(path, files)
        for key in values:
            if key not in known:
                raise SceneError(f"scene file {path} has no parameter '{key}'; "
                                 f"its <default> parameters: {', '.join(known) or 'none'}{closest(key, known)}")
        self.config = mi.parser.ParserConfig(str(mi.variant()))
        self.config.unused_parameters = mi.LogLevel.Debug            # a <default> that nothing uses is no error
        self.resolver = mi.FileResolver(mi.file_resolver())  # type: ignore[operator]
        own = len(self.resolver)
        self.resolver.prepend(str(path.parent))
        _check_folders(folder for file in files.values() for folder in file.folders)
        parser: Any = mi.parser
        with self._finding_files():
            self.state = parser.parse_file(self.config, str(path), **values)
            _check_folders(Path(str(folder)) for folder in list(self.resolver)[:len(self.resolver) - own])
            _check_types(path, self.state)
            parser.transform_upgrade(self.config, self.state)
            parser.transform_resolve_references(self.config, self.state)
            _check_content(path, self.state)
            try:
                self.stated = stated(self.state)
            except SceneError as error:
                raise SceneError(f"scene file {path}: {error}") from None

    @contextmanager
    def _finding_files(self) -> Iterator[None]:
        """Mitsuba looks for files where this scene has them; its errors become one line.

        Raises:
            SceneError: for those errors.
        """
        before = mi.file_resolver()  # type: ignore[operator]
        mi.set_file_resolver(self.resolver)  # type: ignore[operator]
        try:
            yield
        except SceneError:
            raise
        except (RuntimeError, ValueError, TypeError) as error:
            raise SceneError(f"scene file {self.path}: {_one_line(error)}") from error
        finally:
            mi.set_file_resolver(before)  # type: ignore[operator]

    def build(self, width: int | None = None, height: int | None = None, max_depth: int | None = None) -> mi.Scene:
        """The scene, once: it takes what was parsed.

        Args:
            width, height, max_depth: as for :func:`load`.

        Raises:
            SceneError: as `load`.
        """
        parser: Any = mi.parser
        size = {"width": width or self.stated.width, "height": height or self.stated.height}
        for key, value in size.items():
            _check_size(key, value)
        try:
            film = self.stated.window(**size)
        except SceneError as error:
            raise SceneError(f"scene file {self.path}: {error}") from None
        with self._finding_files():
            _standardise(self.state, film, self.stated.max_depth if max_depth is None else max_depth,
                         self.stated.hide_emitters)
            parser.transform_merge_equivalent(self.config, self.state)
            # Not transform_merge_meshes, as mi.load_file: it orders meshes and their emitters by addresses in memory, so that
            # images differ between processes.  It saves no time of rendering (Veach Ajar, dining-room, classroom).
            scene = parser.instantiate(self.config, self.state)
            _check_meshes(self.path, scene)
            return scene


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
    own = [node.props.plugin_name() for _, node in children(state, state.root, kind.Integrator)]
    count = {kind.Sensor: 0, kind.Emitter: 0, kind.Shape: 0}
    media = any(node.type == kind.Medium for node in state.nodes)
    for node in state.nodes:
        plugin = node.props.plugin_name()
        if node.type in count:
            count[node.type] += 1
        if plugin == "timed_sunsky":
            raise SceneError(f"scene file {path}: emitter 'timed_sunsky' is not supported, for no photons can start "
                             "from it; use 'sunsky'")
        for key, medium in children(state, node, kind.Medium) if media and node.type != kind.Scene else ():
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


def _standardise(state: Any, film: dict[str, int], max_depth: int, hide_emitters: bool) -> None:
    """Leave the parsed scene one sensor with our film and sampler, and make `path` its integrator."""
    kind = mi.ObjectType
    (holder, key, sensor), *others = sensors(state)
    index = holder.props[key].index()
    for key, _ in [*children(state, sensor, kind.Film), *children(state, sensor, kind.Sampler)]:
        del sensor.props[key]
    for holder, key, _ in others:
        del holder.props[key]
    for key, _ in children(state, state.root, kind.Integrator):
        del state.root.props[key]
    del holder, sensor, others                      # appending moves the nodes, which leaves these dangling
    box = _append(state, kind.ReconstructionFilter, "box")
    standard_film = _append(state, kind.Film, "hdrfilm", **FILM, **film, standard_filter=box)
    sampler = _append(state, kind.Sampler, "independent")
    path = _append(state, kind.Integrator, "path", max_depth=max_depth, hide_emitters=hide_emitters)
    state.root.props["standard_integrator"] = path
    sensor_props = state.nodes[index].props
    sensor_props["standard_film"], sensor_props["standard_sampler"] = standard_film, sampler


def _append(state: Any, kind: mi.ObjectType, plugin: str, **properties: Any) -> Any:
    """A new node of the parsed scene; returns the reference by which its parent shall hold it."""
    node = mi.parser.SceneNode()
    node.type = kind
    node.props = mi.Properties(plugin)
    for key, value in properties.items():
        node.props[key] = value
    state.nodes.append(node)
    return mi.Properties.ResolvedReference(len(state.nodes) - 1)


def _one_line(error: Exception) -> str:
    """Mitsuba's message without its source positions and line breaks."""
    return " ".join(re.sub(r"\[\w+\.cpp:\d+\]\s*", "", str(error)).split())
