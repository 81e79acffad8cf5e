"""`olpm-bench render`: what a scene file says of its image is kept, or one line says what took its place."""
from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from typer.testing import CliRunner

from olpm_bench.bench import other_process, probe, render_one
from olpm_bench.bench.config import CellSpec
from olpm_bench.bench.exr import read_exr
from olpm_bench.cli import app
from olpm_bench.scenes import SceneError, digest
from olpm_bench.scenes.load import Parsed, load

VIEW = '<transform name="to_world"><lookat origin="0,1,3.5" target="0,1,0" up="0,1,0"/></transform>'
CROP = "".join(f'<integer name="crop_{key}" value="{value}"/>'
               for key, value in (("width", 16), ("height", 12), ("offset_x", 24), ("offset_y", 6)))
FILTER = '<rfilter type="box"/>'
LAMP = """<shape type="rectangle"><transform name="to_world"><scale value="0.6"/><rotate x="1" angle="90"/>
<translate y="1.6" z="0.5"/></transform><emitter type="area"><rgb name="radiance" value="20"/></emitter></shape>"""
ROOM = f"""<bsdf type="twosided" id="w"><bsdf type="diffuse"><rgb name="reflectance" value="0.7,0.6,0.5"/></bsdf></bsdf>
<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="2"/></transform><ref id="w"/></shape>
<shape type="sphere"><point name="center" x="0" y="0.6" z="0"/><float name="radius" value="0.6"/><ref id="w"/></shape>
{LAMP}<emitter type="constant"><rgb name="radiance" value="0.3"/></emitter>"""
PATH = '<integrator type="path"><integer name="max_depth" value="{}"/>{}</integrator>'
HIDDEN = '<boolean name="hide_emitters" value="true"/>'


def sensor(kind: str = "perspective", parts: str = "", film: str = "", width: int = 64, height: int = 48) -> str:
    size = f'<integer name="width" value="{width}"/><integer name="height" value="{height}"/>'
    return f'<sensor type="{kind}">{VIEW}{parts}<film type="hdrfilm">{size}{film or FILTER}</film></sensor>'


CHECK = probe.check         # by another process


@pytest.fixture(autouse=True)
def here(monkeypatch):
    """Files are loaded by this process alone, which is quicker."""
    monkeypatch.setattr(probe, "check", lambda path, overrides: Parsed(path, overrides).stated)


def scene(folder: Path, *parts: str) -> Path:
    file = folder / "room.xml"
    file.write_text(f'<scene version="3.0.0">{"".join(parts)}</scene>')
    return file


def render(file: Path, *options: object):
    out = file.with_name("out.exr")
    return CliRunner().invoke(app, ["render", str(file), "--method", "unguided", "--out", str(out), *map(str, options)])


def cell(file: Path | str, *assignments: str, **options: int) -> CellSpec:
    return render_one.cell(str(file), "unguided", list(assignments), **({"spp": 1} | options))


def described(file: Path, *options: object) -> dict:
    result = render(file, "--json", *options)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def test_the_image_is_of_the_size_and_aspect_that_the_file_says(tmp_path):
    file = scene(tmp_path, sensor(), PATH.format(7, ""), ROOM)
    for size, expected in [({}, (64, 48)), ({"width": 32}, (32, 24)), ({"height": 12}, (16, 12)),
                           ({"width": 8, "height": 12}, (8, 12))]:
        spec = cell(file, **size)
        assert (spec.scene.width, spec.scene.height) == expected and spec.integrator.max_depth == 7
    assert cell(file, max_depth=3).integrator.max_depth == 3
    assert cell(file, "integrator.max_depth=4").integrator.max_depth == 4
    done = described(file, "--spp", 1)
    assert (done["width"], done["height"], done["integrator"]["max_depth"]) == (64, 48, 7)
    assert read_exr(file.with_name("out.exr"))[0]["mean"].shape == (48, 64, 3)


def test_embedded_scenes_keep_the_aspect_of_their_images():
    for size, expected in [({}, (320, 180)), ({"width": 64}, (64, 36)), ({"height": 90}, (160, 90))]:
        spec = cell("cornell_box", **size)
        assert (spec.scene.width, spec.scene.height, spec.integrator.max_depth) == (*expected, 13)


@pytest.mark.parametrize("integrators, depth", [
    ("", -1), ('<integrator type="path"/>', -1), ('<integrator type="direct"/>', 2), ('<integrator type="prb"/>', 6),
    (f'<integrator type="aov"><string name="aovs" value="d:depth"/>{PATH.format(2, "")}</integrator>', 2),
    (f'<integrator type="moment"><integrator type="aov"><string name="aovs" value="d:depth"/>{PATH.format(5, "")}'
     '</integrator></integrator>', 5)])
def test_max_depth_is_that_of_the_integrator_that_traces_paths(tmp_path, integrators, depth):
    parsed = Parsed(scene(tmp_path, sensor(), integrators, ROOM))
    assert parsed.stated.max_depth == depth
    limit = 2**32 - 1 if depth < 0 else depth
    assert f"max_depth = {limit}" in str(parsed.build().integrator())


def test_samples_are_those_of_the_file(tmp_path):
    sampler = '<sampler type="independent"><integer name="sample_count" value="3"/></sampler>'
    file = scene(tmp_path, sensor(parts=sampler), ROOM)
    assert cell(file, spp=None).budget.spp == 3 and cell(file, spp=2).budget.spp == 2
    assert cell(file, spp=None, seconds=1.0).budget.seconds == 1
    refused = render(scene(tmp_path, sensor(), ROOM))
    assert refused.exit_code == 2 and refused.stderr == "olpm-bench: give one of --seconds and --spp\n"


def own(file: Path, spp: int) -> np.ndarray:
    """Mitsuba's own image, of the file as it is."""
    return np.array(mi.render(mi.load_file(str(file), optimize=False), spp=spp))[..., :3]


def agree(image: dict[str, np.ndarray], truth: np.ndarray) -> None:
    """Pixels are within 8 standard errors of the difference of two images of as many samples, estimated from a few passes."""
    error = np.sqrt(2 * image["variance"].mean(-1, keepdims=True))
    assert np.all(np.abs(image["mean"] - truth) < 8 * error + 0.01 * truth + 0.001)
    assert abs(image["mean"].mean() - truth.mean()) < 5 * np.sqrt(np.mean(error**2) / error.size) + 0.001


@pytest.mark.parametrize("method", ["unguided", "cosine"])
def test_hidden_emitters_and_the_crop_window_are_as_in_mitsubas_own_image(tmp_path, method):
    """With a guide a lane takes many paths, whose sums know no alpha."""
    file = scene(tmp_path, sensor(film=CROP + FILTER), PATH.format(2, HIDDEN), ROOM)
    few = ("--set", "training.passes=1", "--set", "training.photons=2000", "--set", "training.camera_passes=1",
           "--set", "training.camera_paths=1000")
    done = described(file, "--spp", 512, "--method", method, *(few if method != "unguided" else ()))
    assert [done["width"], done["height"]] == [16, 12]
    image, truth = read_exr(file.with_name("out.exr"))[0], own(file, 512)
    assert image["mean"].shape == truth.shape == (12, 16, 3)
    agree(image, truth)
    shown = own(scene(tmp_path, sensor(film=CROP + FILTER), PATH.format(2, ""), ROOM), 64)
    assert shown.mean() > 2 * truth.mean()


def test_a_crop_window_keeps_its_view_in_another_size(tmp_path):
    file = scene(tmp_path, sensor(film=CROP + FILTER), PATH.format(2, HIDDEN), ROOM)
    film = load(file, width=32).sensors()[0].film()
    assert list(film.crop_size()) == [32, 12]
    film = load(file, width=40, height=30).sensors()[0].film()
    assert [*film.size(), *film.crop_size(), *film.crop_offset()] == [160, 120, 40, 30, 60, 15]
    half = np.array(mi.render(load(file, width=8, height=6), spp=1024))
    np.testing.assert_allclose(half, own(file, 1024).reshape(6, 2, 8, 2, 3).mean((1, 3)), rtol=0.2, atol=0.01)
    with pytest.raises(SceneError, match=r"room\.xml: its crop window, 16 x 12 pixels from \(60, 6\) on, is not inside"):
        Parsed(scene(tmp_path, sensor(film=CROP.replace('"24"', '"60"')), ROOM))


def test_references_of_versions_that_showed_the_lamp_do_not_count(tmp_path, monkeypatch):
    from olpm_bench import scenes

    for parts, counts in (((PATH.format(2, HIDDEN),), False), ((PATH.format(2, ""),), True)):
        file = scene(tmp_path, sensor(), *parts, ROOM)
        new = digest(file)
        with monkeypatch.context() as older:
            older.setattr(scenes, "HONOURED", set())
            assert (digest(file) == new) == counts


def said(result) -> list[str]:
    """What stands on stderr of the scene, and not of what is going on."""
    return [line for line in result.stderr.splitlines() if "scene file" in line]


def test_one_line_says_what_is_not_as_in_the_file(tmp_path):
    sampler = '<sampler type="multijitter"><integer name="sample_count" value="4"/></sampler>'
    film = '<string name="pixel_format" value="luminance"/><rfilter type="gaussian"/>'
    file = scene(tmp_path, sensor(parts=sampler, film=film), sensor(), PATH.format(7, "").replace('"path"', '"volpath"'), ROOM)
    result = render(file, "--spp", 1, "--width", 8, "--max-depth", 3)
    assert said(result) == [
        f"olpm-bench: scene file {file}: max_depth 3 (the file says 7), 8 x 6 pixels (the file says 64 x 48), "
        "a box filter (the file says gaussian), an RGB image (the file says luminance), "
        "independent samples (the file says multijitter), a path tracer (the file says volpath), "
        "the first sensor alone (the file says 2 of them)"]
    assert said(render(scene(tmp_path, sensor(), PATH.format(7, ""), ROOM), "--spp", 1)) == []


def test_an_experiment_says_it_too(tmp_path):
    file = scene(tmp_path, sensor(), PATH.format(7, ""), ROOM)
    (tmp_path / "test.toml").write_text(f"""title = "T"\nbudget = {{ spp = 1 }}
scene = [{{ name = "room", file = "{file.name}", width = 8, height = 6, reference = "none" }}]
method = [{{ name = "Path tracing" }}]\n""")
    result = CliRunner().invoke(app, ["run", str(tmp_path / "test.toml"), "--results", str(tmp_path / "results")])
    assert result.exit_code == 0, result.output
    assert said(result) == [f"olpm-bench: scene file {file}: max_depth 13 (the file says 7), "
                            "8 x 6 pixels (the file says 64 x 48)"]


# ---------------------------------------------------------------- sensors

METER = '<shape type="rectangle"><transform name="to_world"><scale value="0.2"/><translate y="1.2" z="-1"/></transform>{}</shape>'


@pytest.mark.parametrize("kind, parts", [
    ("thinlens", '<float name="aperture_radius" value="0.1"/><float name="focus_distance" value="3"/>'), ("orthographic", ""),
    ("radiancemeter", ""), ("distant", ""), ("irradiancemeter", "")])
def test_sensors_that_can_trace_rays(tmp_path, kind, parts):
    one = kind in ("radiancemeter", "distant", "irradiancemeter")
    size = (1, 1) if one else (8, 6)
    camera = sensor(kind, parts, "", *size)
    if kind == "irradiancemeter":
        camera = METER.format(camera.replace(VIEW, ""))
    file = scene(tmp_path, camera, PATH.format(3, ""), ROOM)
    done = described(file, "--spp", 2**15 if one else 2**11)
    assert [done["width"], done["height"]] == list(size)
    image = read_exr(file.with_name("out.exr"))[0]
    np.testing.assert_allclose(image["mean"].mean(), own(file, 2**16 if one else 2**11).mean(), rtol=0.03)
    if one:
        refused = render(file, "--spp", 1, "--width", 8)
        assert refused.exit_code == 2
        assert f"room.xml: sensor '{kind}' has an image of 1 x 1 pixels, and not of 8 x 8" in refused.stderr


@pytest.mark.slow
def test_a_guide_learns_from_an_irradiancemeter(tmp_path):
    camera = METER.format(sensor("irradiancemeter", width=1, height=1).replace(VIEW, ""))
    file = scene(tmp_path, camera, PATH.format(3, ""), ROOM)
    few = ("--set", "training.passes=2", "--set", "training.photons=20000", "--set", "training.camera_passes=2",
           "--set", "training.camera_paths=4096")
    done = described(file, "--method", "cosine", "--spp", 2**16, *few)
    assert done["trained"] == 1 and done["mean"] == pytest.approx(described(file, "--spp", 2**16)["mean"], rel=0.02)


# ---------------------------------------------------------------- loading

def test_a_file_is_loaded_by_another_process_once(tmp_path, monkeypatch):
    """Until it, or a file that it names, changes."""
    monkeypatch.setenv("OLPM_BENCH_CACHE", str(tmp_path / "cache"))
    mi.load_dict({"type": "cube"}).write_ply(str(tmp_path / "cube.ply"))
    cube = '<shape type="ply"><string name="filename" value="cube.ply"/></shape>'
    file = scene(tmp_path, sensor(), PATH.format(7, HIDDEN), ROOM, cube)
    first = CHECK(file, {})
    assert first == Parsed(file).stated and (first.max_depth, first.hide_emitters, first.shapes) == (7, True, 4)
    with monkeypatch.context() as nobody:
        nobody.setattr(other_process.Process, "ask", lambda *_: pytest.fail("loaded again"))
        assert CHECK(file, {}) is first
        probe._tried.clear()
        assert CHECK(file, {}) == first
    remembered, = (tmp_path / "cache" / "scenes").iterdir()
    asked = []
    monkeypatch.setattr(other_process.Process, "ask", lambda self, *request: asked.append(request) or {"died": -11})
    remembered.write_text("{")                      # half a file
    probe._tried.clear()
    with pytest.raises(SceneError, match="SIGSEGV"):
        CHECK(file, {})
    probe._tried.clear()
    with (tmp_path / "cube.ply").open("ab") as stream:
        stream.write(b"0")
    with pytest.raises(SceneError, match="SIGSEGV"):
        CHECK(file, {})
    assert len(asked) == 2


def test_where_nothing_can_be_remembered_files_are_loaded_all_the_same(tmp_path, monkeypatch):
    monkeypatch.setenv("OLPM_BENCH_CACHE", str(tmp_path / "room.xml"))         # is no folder
    file = scene(tmp_path, sensor(), ROOM)
    assert CHECK(file, {}).shapes == 3


# ---------------------------------------------------------------- what is said

def test_render_says_in_three_lines_what_where_and_how_good(tmp_path):
    file = scene(tmp_path, sensor(), PATH.format(7, ""), ROOM)
    result = render(file, "--spp", 2)
    what, where, how = result.stdout.splitlines()
    assert what == "room by unguided: 64 x 48 pixels of 2 samples, paths of up to 7 segments"
    assert where == f"{file.with_name('out.exr')}, {file.with_name('out.png')}"
    assert "s charged (" in how and "compiling; mean " in how and "% of the signal" in how


def test_summary_of_a_guided_image():
    done = {"scene": "room", "method": "jensen", "width": 8, "height": 6, "spp": 4, "integrator": {"max_depth": -1},
            "out": "a.exr", "png": "a.png", "guide": "g.npz", "records_map": "m.png",
            "charged_seconds": 10.0, "train_seconds": 4.0, "render_seconds": 6.0, "compile_seconds": 1.5,
            "mean": 0.25, "mean_stderr": 0.002, "noise": 0.123, "trained": 0.5, "records": 77}
    assert render_one.summary(done) == [
        "room by jensen: 8 x 6 pixels of 4 samples, paths of any length",
        "a.exr, a.png, guide g.npz, map of the records m.png",
        "10.0 s charged (4.0 s training, 6.0 s rendering), and 1.5 s compiling; mean 0.25 +- 0.002, noise 12 % of the signal, "
        "50% of what the camera sees is guided by 77 records"]


def test_noise_is_that_of_the_pixels_over_the_signal():
    image = {"mean": np.full((2, 2, 3), 3.0), "variance": np.full((2, 2, 3), 0.09)}
    assert render_one.noise(image) == pytest.approx(0.1)
    assert render_one.noise(image | {"mean": np.zeros((2, 2, 3))}) is None
    assert render_one.noise(image | {"variance": np.full((2, 2, 3), np.inf)}) is None
