"""What is looked at once in a scene, and what a guide knows of the one that it was trained in."""
from __future__ import annotations

import json
import warnings
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from small_scenes import box, grey, lamp

import olpm_bench
from olpm_bench.transport.scene_checks import Fingerprint, require_valid_box
from olpm_bench.transport.settings import InputError

DEPTH = 3
FEW = {"passes": 1, "photons": 2000, "importons": 500, "camera_passes": 1, "camera_paths": 500, "record_radius": 0.1}
MERGED = "have no valid bounding box.*load_scene.*optimize=False"


def room(folder: Path, light: str) -> Path:
    """A floor and two walls, rectangles of one material, which Mitsuba's loader merges."""
    walls = "".join(f'<shape type="rectangle"><transform name="to_world"><rotate {axis}="1" angle="{angle}"/></transform>'
                    '<ref id="grey"/></shape>' for axis, angle in (("x", -90), ("x", 0), ("y", 90)))
    file = folder / "room.xml"
    file.write_text('<scene version="3.0.0"><sensor type="perspective"><film type="hdrfilm"><integer name="width" value="8"/>'
                    f'<integer name="height" value="6"/></film></sensor><bsdf type="diffuse" id="grey"/>{walls}{light}</scene>')
    return file


@pytest.mark.parametrize("light", [
    '<emitter type="constant"/>',
    '<emitter type="directional"><vector name="direction" value="0,0,1"/></emitter>'])
def test_merged_meshes_under_lights_at_infinity_are_refused(tmp_path, light):
    file = room(tmp_path, light)
    merged = mi.load_file(str(file))
    with pytest.raises(InputError, match=MERGED):
        olpm_bench.train(merged, "cosine", **FEW)
    with pytest.raises(InputError, match=MERGED):
        olpm_bench.integrator().render(merged, spp=1)
    for scene in (mi.load_file(str(file), optimize=False), olpm_bench.load_scene(file)):
        require_valid_box(scene)
        assert np.isfinite(mi.render(scene, integrator=olpm_bench.integrator(max_depth=DEPTH), spp=1).numpy()).all()


def test_merged_meshes_matter_to_no_other_light(tmp_path):
    require_valid_box(mi.load_file(str(room(tmp_path, '<emitter type="point"/>'))))


def test_a_scene_is_looked_at_once(tmp_path, monkeypatch):
    from olpm_bench.transport import path

    seen = []
    integrator = olpm_bench.integrator(max_depth=DEPTH)
    monkeypatch.setattr(path, "require_valid_box", seen.append)
    first, other = (olpm_bench.load_scene("cornell_box", width=8, height=6) for _ in range(2))
    for scene in (first, first, other, other, first):
        mi.render(scene, integrator=integrator, spp=1)
    assert [any(scene is known for known in (first, other)) for scene in seen] == [True] * 3


# ---------------------------------------------------------------- guides

@pytest.fixture(scope="module")
def scene() -> mi.Scene:
    return mi.load_dict(box(grey(0.5), lamp=lamp()), optimize=False)


@pytest.fixture(scope="module")
def guide(scene):
    return olpm_bench.train(scene, "cosine", max_depth=DEPTH, **FEW)


def test_a_guide_of_another_scene_warns_once(scene, guide, tmp_path):
    guide.save(tmp_path / "guide.npz")
    ball = {"type": "sphere", "radius": 0.2, "bsdf": grey(0.5)}
    for content, words in [({"ball": ball}, "shapes, and not"),
                           ({"spot": {"type": "point", "position": [0, 0, 0]}}, "emitters, and not"),
                           ({"lamp": lamp() | {"to_world": mi.ScalarTransform4f().translate([0, 5, 0])}}, "the bounding box ")]:
        other = mi.load_dict(box(grey(0.5), lamp=lamp()) | content, optimize=False)
        integrator = olpm_bench.integrator(tmp_path / "guide.npz", max_depth=DEPTH)
        with pytest.warns(UserWarning, match=f"the guide was trained in another scene: this one has .*{words}") as said:
            for _ in range(3):
                mi.render(other, integrator=integrator, spp=1)
        assert len(said) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for used in (guide, olpm_bench.load_guide(tmp_path / "guide.npz")):
            mi.render(scene, integrator=olpm_bench.integrator(used, max_depth=DEPTH), spp=1)


def test_a_guide_of_a_version_that_kept_no_fingerprint_is_read_and_warns_of_nothing(guide, tmp_path):
    guide.save(tmp_path / "guide.npz")
    arrays = dict(np.load(tmp_path / "guide.npz"))
    meta = json.loads(str(arrays["meta"]))
    assert Fingerprint.from_json(meta["scene"]) == guide.scene
    for scene, broken in ((None, False), ("absent", False), ({"shapes": 3}, True),
                          ({"shapes": 3, "emitters": 1, "box": [1]}, True)):
        other = {k: v for k, v in meta.items() if k != "scene"} | ({"scene": scene} if scene != "absent" else {})
        np.savez(tmp_path / "other.npz", **arrays | {"meta": np.array(json.dumps(other))})
        if broken:
            with pytest.raises(InputError, match=r"other\.npz: not a whole guide file"):
                olpm_bench.load_guide(tmp_path / "other.npz")
        else:
            assert olpm_bench.load_guide(tmp_path / "other.npz").scene is None


def test_scenes_without_a_valid_box_are_told_apart():
    boxes = [(0.0, 0.0, 0.0, 1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 1.0, 1.0, 1.0005), (0.0, 0.0, 0.0, 1.0, 1.0, 1.5), None]
    one, near, far, none = (Fingerprint(3, 1, box) for box in boxes)
    assert one.difference(near) is one.difference(one) is none.difference(none) is None
    assert one.difference(far) == "the bounding box (0, 0, 0) to (1, 1, 1), and not (0, 0, 0) to (1, 1, 1.5)"
    assert none.difference(one) == one.difference(none) == "another bounding box"
