"""Loading: any scene becomes one with a box-filtered RGB film; what cannot be used is refused in one clear line."""
from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import others
import pytest

from olpm_bench import scenes
from olpm_bench.scenes import SceneError
from olpm_bench.scenes.geometry import turn_z
from olpm_bench.scenes.load import load

BITTERLI = ["classroom", "dining-room", "living-room", "staircase2", "veach-ajar", "veach-bidir"]

SENSOR = """<sensor type="perspective"><float name="fov" value="40"/>
  <sampler type="multijitter"><integer name="sample_count" value="16"/></sampler>
  <film type="hdrfilm"><integer name="width" value="$resx"/><integer name="height" value="30"/>
    <string name="pixel_format" value="luminance"/><rfilter type="gaussian"/></film></sensor>"""
SHAPE = '<shape type="sphere" id="ball"><point name="center" x="0" y="0" z="5"/></shape>'
EMITTER = '<emitter type="constant"/>'
PATH = '<integrator type="path"><integer name="max_depth" value="7"/></integrator>'
FOG = '<medium type="homogeneous" name="interior"><rgb name="albedo" value="{}"/></medium>'


def xml(folder: Path, *parts: str, name: str = "scene.xml") -> Path:
    file = folder / name
    file.write_text(f'<scene version="3.0.0"><default name="resx" value="40"/>{"".join(parts)}</scene>')
    return file


def is_standard(scene: mi.Scene, width: int, height: int) -> bool:
    sensor, = scene.sensors()
    film = sensor.film()
    image = mi.render(scene, spp=1)
    return (list(film.size()) == [width, height] and film.rfilter().class_name() == "BoxFilter"
            and film.class_name() == "HDRFilm" and image.shape == (height, width, 3)
            and sensor.sampler().class_name() == "IndependentSampler"
            and scene.integrator().class_name() == "PathIntegrator")


def test_embedded_scenes():
    assert list(scenes.names()) == ["door_ajar", "living_room", "classroom", "cornell_box"]
    assert all(description.endswith(".") for description in scenes.names().values())
    for name in scenes.names():
        assert is_standard(load(name, None, 20, 12, max_depth=3), 20, 12)
    assert load("cornell_box").sensors()[0].film().size()[0] == 256


def test_a_file_gets_our_film_sampler_and_integrator(tmp_path: Path):
    file = xml(tmp_path, SENSOR, SHAPE, EMITTER, PATH)
    assert is_standard(load(file), 40, 30)
    assert is_standard(load(file, {"resx": 50}), 50, 30)
    assert is_standard(load(str(file), {"resx": 50}, 24, 16), 24, 16)
    assert "max_depth = 7" in str(load(file).integrator())
    assert "max_depth = 3" in str(load(file, max_depth=3).integrator())


def test_a_sensor_without_film_and_a_scene_without_integrator(tmp_path: Path):
    file = xml(tmp_path, '<sensor type="perspective"/>', SHAPE, EMITTER)
    assert is_standard(load(file, width=32, height=18), 32, 18)


def test_the_first_of_several_sensors_is_used(tmp_path: Path):
    wide = SENSOR.replace('value="40"', 'value="90"')
    one, two, other = (load(xml(tmp_path, *parts, SHAPE, EMITTER, PATH), width=24, height=16)
                       for parts in ((SENSOR,), (SENSOR, wide), (wide, SENSOR)))
    assert is_standard(two, 24, 16)
    image = [np.array(mi.render(s, spp=4, seed=3)) for s in (one, two, other)]
    assert np.array_equal(image[0], image[1])
    assert not np.array_equal(image[0], image[2])


def test_files_are_found_beside_the_scene_and_in_includes(tmp_path: Path):
    mi.load_dict({"type": "cube"}).write_ply(str(tmp_path / "cube.ply"))
    ply = '<shape type="ply"><string name="filename" value="$mesh.ply"/></shape>'
    (tmp_path / "part.xml").write_text(f'<scene version="3.0.0">{ply}</scene>')
    file = xml(tmp_path, '<default name="mesh" value="cube"/>', SENSOR, EMITTER, '<include filename="part.xml"/>')
    resolver = str(mi.file_resolver())
    assert len(load(file).shapes()) == 1
    assert str(mi.file_resolver()) == resolver
    with pytest.raises(SceneError, match=r"sphere\.ply") as error:
        load(file, {"mesh": "sphere"})
    assert "\n" not in str(error.value)


def test_includes_inside_each_other(tmp_path: Path):
    """As deep as Mitsuba follows them, and no deeper."""
    for i in range(scenes.MOST_INCLUDES + 1):
        xml(tmp_path, f'<include filename="{i + 1}.xml"/>', name=f"{i}.xml")
    xml(tmp_path, SENSOR, SHAPE, EMITTER, name=f"{scenes.MOST_INCLUDES + 1}.xml")
    assert len(load(tmp_path / "1.xml").shapes()) == 1
    with pytest.raises(SceneError, match=r"0\.xml: files include each other more than 14 deep"):
        load(tmp_path / "0.xml")
    with pytest.raises(RuntimeError, match="recursion depth"):
        mi.load_file(str(tmp_path / "0.xml"))


@pytest.mark.parametrize("name", BITTERLI)
@pytest.mark.filterwarnings("ignore:.*only absorbs")
def test_shared_scenes(name: str):
    scene = load(others.folder_of(name) / "scene.xml", None, 96, 54)
    film = scene.sensors()[0].film()
    assert list(film.size()) == [96, 54]
    assert film.rfilter().class_name() == "BoxFilter"


def test_shapes_and_emitters_keep_the_order_of_the_file(tmp_path: Path):
    emitter = '<emitter type="area"><rgb name="radiance" value="{0}"/></emitter>'
    lamp = f'<shape type="cube" id="lamp{{0}}"><bsdf type="diffuse"/>{emitter}</shape>'
    scene = load(xml(tmp_path, SENSOR, *(lamp.format(i) for i in range(1, 9))))
    assert [shape.id() for shape in scene.shapes()] == [f"lamp{i}" for i in range(1, 9)]
    assert [mi.traverse(emitter)["radiance.value"].x[0] for emitter in scene.emitters()] == list(range(1, 9))


def test_an_absorbing_medium_is_ignored_only_where_the_file_ignores_it(tmp_path: Path):
    ball = SHAPE.replace("</shape>", FOG.format("0, 0, 0") + "</shape>")
    with pytest.warns(UserWarning, match="shape 'ball' has the participating medium 'homogeneous', which only absorbs"):
        load(xml(tmp_path, SENSOR, ball, EMITTER, PATH))
    with pytest.raises(SceneError, match="only surfaces"):
        load(xml(tmp_path, SENSOR, ball, EMITTER, PATH.replace('"path"', '"volpath"')))


FOGGY = SHAPE.replace("</shape>", FOG.format(".5, .5, .5") + "</shape>")


@pytest.mark.parametrize("parts, message", [
    ((SENSOR, SHAPE), "has no emitter"),
    ((SHAPE, EMITTER), "has no sensor"),
    ((SENSOR, EMITTER), "has no shape"),
    ((SENSOR, FOGGY, EMITTER, PATH), "shape 'ball' has the participating medium 'homogeneous'; only surfaces"),
    ((SENSOR.replace("<film", FOG.format(".5, .5, .5") + "<film"), SHAPE, EMITTER), "sensor 'perspective' has the"),
    ((SENSOR, SHAPE, '<emitter type="timed_sunsky"/>'), "'timed_sunsky' is not supported"),
    ((SENSOR, SHAPE, EMITTER, "<foo/>"), "foo"),
    ((SENSOR, SHAPE, '<emitter type="nonesuch"/>'), "nonesuch"),
    ((SENSOR, SHAPE, "<emitter"), "not well-formed XML"),
    ((SENSOR, SHAPE, '<emitter type="&sky;"/>'), "not well-formed XML: undefined entity"),
    ((SENSOR, '<shape type="obj"><string name="filename" value="no.obj"/></shape>', EMITTER), "no.obj"),
    ((SENSOR, SHAPE, EMITTER, '<include filename="no.xml"/>'), "no.xml: there is no such file"),
    ((SENSOR.replace("30", "0"), SHAPE, EMITTER), "height = 0: must be"),
])
def test_unusable_files(tmp_path: Path, parts: tuple, message: str):
    with pytest.raises(SceneError, match=message) as error:
        load(xml(tmp_path, *parts))
    assert "\n" not in str(error.value)
    assert "scene.xml" in str(error.value) or "height" in str(error.value) or "no.xml" in str(error.value)


@pytest.mark.parametrize("declared", ["", ' SYSTEM "scene.dtd"', ' [<!ENTITY sky "constant">]',
                                      ' [<!ATTLIST shape type CDATA "sphere">]'])
def test_a_doctype_is_refused_as_mitsuba_passes_over_what_it_declares(tmp_path: Path, declared: str):
    file = xml(tmp_path, SENSOR, SHAPE, EMITTER, name="part.xml")
    file.write_text(f"<!DOCTYPE scene{declared}>{file.read_text()}")
    whole = xml(tmp_path, '<include filename="part.xml"/>')
    for read in (load, scenes.digest):
        for path in (file, whole):
            with pytest.raises(SceneError, match=r"scene file \S*part\.xml has a DOCTYPE, .*; write the file without$"):
                read(path)


@pytest.mark.parametrize("arguments, message", [
    (("door_ajaar",), "unknown scene 'door_ajaar'; known: door_ajar, living_room, classroom, cornell_box"),
    (("nowhere/scene.xml",), "nowhere/scene.xml: there is no such file"),
    (("cornell_box", {"size": 1}), "no parameter 'size'; known: light_size, rotation"),
    (("cornell_box", {"light_size": 3}), "light_size = 3.0: must be in"),
    (("cornell_box", None, 0), "width = 0: must be an integer in"),
    (("cornell_box", None, 8, -1), "height = -1"),
    (("cornell_box", None, 8.5, 8), "width = 8.5"),
    (("cornell_box", None, 8, 8, 0), "max_depth = 0: must be"),
])
def test_unusable_arguments(arguments: tuple, message: str):
    with pytest.raises(SceneError, match=message):
        load(*arguments)


def test_unknown_parameters_of_a_file(tmp_path: Path):
    file = xml(tmp_path, SENSOR, SHAPE, EMITTER)
    with pytest.raises(SceneError, match="no parameter 'rex'; its <default> parameters: resx"):
        load(file, {"rex": 3})
    with pytest.raises(SceneError, match=r"scene\.xml"):
        load(file, {"resx": "many"})
    (tmp_path / "picture.xml").write_bytes(b"\x89PNG\r\n\x1a\n\0\0")
    with pytest.raises(SceneError, match="not well-formed XML"):
        load(tmp_path / "picture.xml")
    (tmp_path / "note.xml").write_text("<note/>")
    with pytest.raises(SceneError, match="root element is <note>"):
        load(tmp_path / "note.xml")


def test_other_variants_are_refused():
    try:
        for variant in [v for v in mi.variants() if v in ("scalar_rgb", "scalar_spectral", "llvm_ad_spectral")]:
            mi.set_variant(variant)
            with pytest.raises(SceneError, match=f"'{variant}': must be llvm_ad_rgb or cuda_ad_rgb"):
                load("cornell_box")
    finally:
        mi.set_variant("llvm_ad_rgb")


def test_digest_follows_what_determines_the_image(tmp_path: Path):
    door = scenes.digest("door_ajar")
    assert len(door) == 64
    assert door == scenes.digest("door_ajar", {"gap": 0.07, "rotation": 23.7})
    assert door != scenes.digest("door_ajar", {"gap": 0.08})
    assert door != scenes.digest("cornell_box")

    mesh = '<default name="mesh" value="a.ply"/><shape type="ply"><string name="filename" value="$mesh"/></shape>'
    (tmp_path / "a.ply").write_text("12")
    file = xml(tmp_path, mesh)
    first = scenes.digest(file)
    assert first == scenes.digest(str(file))
    assert first != scenes.digest(file, {"mesh": "b.ply"})
    (tmp_path / "a.ply").write_text("123")
    assert first != scenes.digest(file)
    (tmp_path / "a.ply").write_text("12")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "a.ply").write_text("12")
    assert first == scenes.digest(xml(elsewhere, mesh))
    assert first != scenes.digest(xml(tmp_path, mesh, SHAPE))


def test_digest_follows_the_files_that_mitsuba_finds(tmp_path: Path):
    """Of spectra and images of one name in three folders: as Mitsuba's radiance changes, so does the digest, and only then."""
    radiance = '<spectrum name="radiance" filename="$lamp"/>'
    sky = '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
    parts = {"sub/a.xml": '<default name="lamp" value="late"/><include filename="b.xml"/>',
             "sub/b.xml": f'<include filename="deep/c.xml"/>{sky}',
             "sub/deep/c.xml": f'<shape type="sphere"><emitter type="area">{radiance}</emitter></shape>'}
    folders = [tmp_path, tmp_path / "sub", tmp_path / "sub" / "deep"]
    for folder in folders:
        folder.mkdir(exist_ok=True)
        (folder / "gold.spd").write_text("400 1\n700 1\n")
        mi.Bitmap(np.ones((2, 4, 3), np.float32)).write(str(folder / "sky.exr"))
    for name, part in parts.items():
        (tmp_path / name).write_text(f'<scene version="3.0.0">{part}</scene>')
    file = xml(tmp_path, '<default name="la" value="x"/><default name="lamp" value="gold.spd"/>', SENSOR,
               '<include filename="sub/a.xml"/>')

    def seen() -> tuple[list[float], str]:
        scene = load(file)
        lamp, sky = mi.traverse(scene.shapes()[0].emitter()), mi.traverse(scene.environment())
        return [float(np.mean(lamp["radiance.value"].numpy())), float(np.mean(sky["data"].numpy()))], scenes.digest(file)

    values, digest = seen()
    changed = []
    for folder in folders:
        for name in ("gold.spd", "sky.exr"):
            if name == "gold.spd":
                (folder / name).write_text("400 3\n700 3\n")
            else:
                mi.Bitmap(np.full((2, 4, 3), 2, np.float32)).write(str(folder / name))
            (before, old), (values, digest) = (values, digest), seen()
            assert (before != values) == (old != digest)
            changed.append(before != values)
    assert changed == [False, True, True, False, False, False], values


def test_the_registry_needs_no_mitsuba():
    code = ("import sys; from olpm_bench import scenes; scenes.names(); scenes.parameters('door_ajar'); "
            "scenes.digest('door_ajar'); assert not {'mitsuba', 'drjit'} & set(sys.modules)")
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).resolve().parents[2])


@pytest.mark.parametrize("rotation", [0.0, 23.7, 200.0])
@pytest.mark.parametrize("name, points", [
    ("door_ajar", [(0.25, 0.1, 1.5), (1.8, 2.69, 0), (1.8, 2.8, 1), (0.5, 4.4, 2.1)]),
    ("living_room", [(0.3, 0.25, 1.35), (3.4, 4, 2.5), (3.5, 0, 0), (6, 3.75, 1), (5, 3.8, 1), (5, 9, 0)]),
    ("classroom", [(0.25, 0.35, 1.75), (7.4, 5.6, 3.1), (1.5, 5.7, 1.5), (-0.1, 2, 1)]),
])
def test_rooms_of_points(name, points, rotation):
    """The camera's first; by the scenes' plans, whose surfaces belong to the rooms that see them."""
    rooms, room = scenes.rooms(name, {"rotation": rotation})
    expected = sorted(list(range(len(rooms))) * 2)
    np.testing.assert_array_equal(room(np.array(points) @ turn_z(rotation).T), expected)


def test_a_scene_of_one_room_has_none_to_tell_apart():
    assert scenes.rooms("cornell_box") is None
    with pytest.raises(SceneError, match="no parameter 'gap'"):
        scenes.rooms("cornell_box", {"gap": 1})


def test_files_are_found_in_the_folders_of_path_elements(tmp_path: Path):
    """As Mitsuba finds them: the last <path> first, that of an include by the include alone."""
    sky = '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
    lamp = '<shape type="sphere"><emitter type="area"><spectrum name="radiance" filename="lamp.spd"/></emitter></shape>'
    for value, name in enumerate(["", "a", "b", "c"], 1):
        (tmp_path / name).mkdir(exist_ok=True)
        mi.Bitmap(np.full((2, 4, 3), value, np.float32)).write(str(tmp_path / name / "sky.exr"))
        (tmp_path / name / "lamp.spd").write_text(f"400 {value}\n700 {value}\n")
    (tmp_path / "c" / "part.xml").write_text(f'<scene version="3.0.0"><path value="c"/>{lamp}</scene>')
    (tmp_path / "c" / "c").mkdir()
    (tmp_path / "c" / "c" / "lamp.spd").write_text("400 9\n700 9\n")

    def found(*parts: str) -> tuple[float, float]:
        file = xml(tmp_path, SENSOR, *parts)
        scene, theirs = load(file), mi.load_file(str(file), optimize=False)
        values = [(float(np.mean(mi.traverse(s.shapes()[0].emitter())["radiance.value"].numpy())),
                   float(np.mean(mi.traverse(s.environment())["data"].numpy()))) for s in (scene, theirs)]
        np.testing.assert_allclose(*values)
        return values[0]

    assert found(lamp, sky)[1] == pytest.approx(1)
    ones = [found(lamp, '<path value="a"/>', '<path value="b"/>', sky), found('<path value="a"/>', lamp, sky)]
    assert [sky for _, sky in ones] == pytest.approx([3, 2])
    assert ones[1][0] / ones[0][0] == pytest.approx(2)                      # before and after the path
    nine = found('<path value="c"/>', '<include filename="part.xml"/>', sky)
    assert nine[1] == pytest.approx(4) and nine[0] / ones[0][0] == pytest.approx(9)

    file = xml(tmp_path, SENSOR, '<path value="a"/>', lamp, sky)
    before = scenes.digest(file)
    for folder, changes in (("", False), ("b", False), ("a", True)):
        (tmp_path / folder / "lamp.spd").write_text("400 7\n700 7\n")
        assert (scenes.digest(file) != before) == changes
    with pytest.raises(SceneError, match=r"scene\.xml: <path>: there is no folder 'nowhere'"):
        load(xml(tmp_path, SENSOR, SHAPE, EMITTER, '<path value="nowhere"/>'))
