"""Mitsuba XML, meshes and images that are broken in any way: a scene, or one line; what kills Mitsuba kills another process."""
from __future__ import annotations

import copy
from pathlib import Path
from xml.etree import ElementTree

import pytest
from child import child
from hypothesis import example, given
from hypothesis import strategies as st
from mutations import NAMES, NUMBERS, examples, mutated_bytes
from typer.testing import CliRunner

from olpm_bench.cli import app

XML = """<scene version="3.0.0"><default name="resx" value="8"/><default name="mesh" value="square"/>
<integrator type="path"><integer name="max_depth" value="7"/></integrator>
<sensor type="perspective"><float name="fov" value="40"/>
<transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
<sampler type="independent"><integer name="sample_count" value="4"/></sampler>
<film type="hdrfilm"><integer name="width" value="$resx"/><integer name="height" value="6"/><rfilter type="box"/></film></sensor>
<bsdf type="twosided" id="grey"><bsdf type="roughplastic"><float name="alpha" value="0.1"/>
<string name="distribution" value="ggx"/>
<rgb name="diffuse_reflectance" value="0.5, 0.4, 0.3"/></bsdf></bsdf>
<bsdf type="diffuse" id="picture"><texture type="bitmap" name="reflectance"><string name="filename" value="picture.exr"/>
<transform name="to_uv"><scale x="2" y="2"/></transform></texture></bsdf>
<shape type="ply" id="floor"><string name="filename" value="$mesh.ply"/><boolean name="face_normals" value="true"/>
<ref id="picture"/></shape>
<shape type="obj"><string name="filename" value="square.obj"/><transform name="to_world"><rotate x="1" angle="90"/>
<translate x="0" y="1" z="0"/></transform><ref id="grey"/></shape>
<shape type="sphere"><point name="center" x="0" y="0" z="1"/><float name="radius" value="0.2"/><bsdf type="dielectric"/></shape>
<shape type="rectangle"><emitter type="area"><rgb name="radiance" value="4"/></emitter></shape>
<emitter type="envmap"><string name="filename" value="picture.exr"/><float name="scale" value="0.5"/></emitter>
<emitter type="spot"><rgb name="intensity" value="1"/><float name="cutoff_angle" value="20"/></emitter></scene>"""
PLY = b"""ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
end_header
-1 -1 0
1 -1 0
1 1 0
-1 1 0
3 0 1 2
3 0 2 3
"""
OBJ = b"v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvt 0 0\nvt 1 1\nvn 0 0 1\nf 1/1/1 2/1/1 3/2/1 4/2/1\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    import numpy as np

    from olpm_bench.bench.exr import write_exr
    folder = tmp_path_factory.mktemp("scenes")
    write_exr(folder / "picture.exr", {"mean": np.ones((4, 8, 3), np.float32)})
    (folder / "square.ply").write_bytes(PLY)
    (folder / "square.obj").write_bytes(OBJ)
    return folder


@st.composite
def elements(draw: st.DrawFn, valid: str) -> bytes:
    """XML with one or two elements deleted, doubled, moved or renamed, or attributes of other values."""
    root = ElementTree.fromstring(valid)
    for _ in range(draw(st.integers(1, 2))):
        parents = [(parent, child) for parent in root.iter() for child in parent]
        if not parents:
            break
        parent, element = draw(st.sampled_from(parents))
        how = draw(st.sampled_from(["delete", "double", "move", "tag", "drop", "name", "value", "value", "value", "value"]))
        if how == "delete":
            parent.remove(element)
        elif how == "double":
            parent.append(copy.deepcopy(element))
        elif how == "move":
            other = draw(st.sampled_from(parents))[1]
            other.append(copy.deepcopy(element))
        elif how == "tag":
            element.tag = draw(st.sampled_from(["bsdf", "shape", "emitter", "texture", "ref", "include", "float", "integer",
                                                "string", "rgb", "default", "scene", "medium", "transform", "lookat", "foo"]))
        elif element.attrib:
            key = draw(st.sampled_from(sorted(element.attrib)))
            if how == "drop":
                del element.attrib[key]
            elif how == "name":
                element.attrib[draw(st.sampled_from(["id", "name", "type", "value", "x", "filename"]))] = element.attrib.pop(key)
            else:
                texts = [*NAMES, *map(str, NUMBERS), "1, 2", "1 2 3 4", "-1", "9" * 40, "true", "grey", "floor", "square.ply",
                         "mask", "scene.xml"]
                element.attrib[key] = "".join(c for c in draw(st.sampled_from(texts)) if c >= " ")
    return ElementTree.tostring(root, "utf-8")


def judge(process, folder: Path, xml: bytes, kind: str = "scene") -> str:
    """The scene read by a process as shields the commands, which may be killed by Mitsuba; returns what came of it.

    What kills a command must already kill that process, which comes before it: the load.
    """
    def files() -> list[tuple[Path, int]]:
        return sorted((p, p.stat().st_mtime_ns) for p in folder.rglob("*") if "results" not in p.parts)

    (folder / "scene.xml").write_bytes(xml)
    before = files()
    answer = process.ask(kind, str(folder / "scene.xml"))
    assert {"ok", "refused", "died"} & answer.keys(), answer
    assert kind == "scene" or "died" not in answer or "died" in process.ask("scene", str(folder / "scene.xml")), answer
    assert files() == before
    return next(iter(answer))


@pytest.fixture(scope="module")
def process(folder):
    with child() as process:
        yield process
        assert judge(process, folder, XML.encode()) == "ok", "after so many files it refuses a whole one"
        print(process)              # pytest -rP shows it; each start but the first follows a death of Mitsuba


@example(xml=XML.replace('"reflectance"><string name="filename"', '"reflectance"><string name="file"').encode()).via(
    "a bitmap without file name, which kills Mitsuba 3.9.1")
@examples(0.19)
@given(xml=elements(XML))
def test_elements_that_are_broken(process, folder, xml):
    judge(process, folder, xml)


@examples(0.01)
@given(xml=elements(XML))
def test_elements_that_are_broken_and_rendered(process, folder, xml):
    (folder / "results").mkdir(exist_ok=True)
    judge(process, folder, xml, "render")


@examples(0.05)
@given(xml=mutated_bytes(XML.encode(), dictionary=(b"<", b"/>", b"&#0;", b"<!--", b"<![CDATA[", b"<!DOCTYPE a [", b'"')))
def test_bytes_that_are_broken(process, folder, xml):
    judge(process, folder, xml)


@examples(0.05)
@given(data=st.data(), name=st.sampled_from(["square.ply", "square.obj", "picture.exr"]))
def test_meshes_and_images_that_are_broken(process, folder, data, name):
    whole = (folder / name).read_bytes()
    try:
        (folder / name).write_bytes(data.draw(mutated_bytes(whole, most=2)))
        judge(process, folder, XML.encode())
    finally:
        (folder / name).write_bytes(whole)


def test_the_whole_scene_is_read(process, folder):
    (folder / "results").mkdir(exist_ok=True)
    assert judge(process, folder, XML.encode()) == judge(process, folder, XML.encode(), "render") == "ok"
    assert (folder / "results" / "image.exr").is_file()


def far(folder: Path) -> str:
    """A PLY whose face names a vertex far beyond its last one; Mitsuba 3.9.1 is killed by it."""
    (folder / "far.ply").write_bytes(PLY.replace(b"3 0 2 3", b"3 0 2 1000000000"))
    return '<shape type="ply"><string name="filename" value="far.ply"/></shape>'


SENSOR, SKY, BALL = '<sensor type="perspective"/>', '<emitter type="constant"/>', '<shape type="sphere"/>'


@pytest.mark.parametrize("part, words", [
    pytest.param("<bsdf type=\"twosided\">" * 20000 + "</bsdf>" * 20000, "deep; at most 100", id="too deep"),
    pytest.param(BALL.replace("sphere", "ply").replace("/>", '><string name="filename" value="/dev/zero"/></shape>'),
                 "/dev/zero is no file", id="a device that never ends"),
    pytest.param('<bsdf type="diffuse"><spectrum name="reflectance" filename="/dev/zero"/></bsdf>', "/dev/zero is no file",
                 id="so for a spectrum"),
    pytest.param(BALL.replace("sphere", "ply").replace("/>", '><string name="filename" value="near.ply"/></shape>'),
                 "names vertex 4 of 4", id="a face with a vertex that is not there"),
    pytest.param('<bsdf type="twosided" id="a"><ref id="a"/></bsdf>', "circular reference", id="a reference to itself"),
    pytest.param('<default name="a0" value="x"/>' + "".join(f'<default name="a{i + 1}" value="$a{i}$a{i}"/>' for i in range(40)),
                 "parameter 'a13' has 8192 characters, at most 4096", id="a value that grows without bounds"),
    pytest.param('<include filename="scene.xml"/>', "recursion", id="a file that includes itself"),
    pytest.param('<shape type="../sphere"/>', "is the name of no plugin", id="a plugin that is a path"),
])
def test_scenes_that_crashed_or_hung(process, folder, part, words):
    (folder / "near.ply").write_bytes(PLY.replace(b"3 0 2 3", b"3 0 2 4"))
    (folder / "scene.xml").write_text(f'<scene version="3.0.0">{SENSOR}{SKY}{BALL}{part}</scene>')
    answer = process.ask("scene", str(folder / "scene.xml"))
    assert words in answer.get("refused", ""), answer


@pytest.mark.parametrize("command", ["render {} --method unguided --spp 1 --out a.exr", "perf --scene {}"])
def test_what_kills_mitsuba_kills_another_process(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    scene = tmp_path / "scene.xml"
    scene.write_text(f'<scene version="3.0.0">{SENSOR}{SKY}{far(tmp_path)}</scene>')
    result = CliRunner().invoke(app, command.format(scene).split())
    assert result.exit_code == 2 and f"scene file {scene}: Mitsuba crashes when it loads it (SIG" in result.stderr
    assert len(result.stderr.splitlines()) == 1 and not (tmp_path / "a.exr").exists()
