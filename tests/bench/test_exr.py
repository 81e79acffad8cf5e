"""EXRs: what is written is what is read, by us and by others; theirs are read, too."""
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from olpm_bench.bench.exr import read_exr, write_exr
from olpm_bench.bench.files import ResultError
from olpm_bench.bench.reference_file import read_reference
from olpm_bench.transport import headroom
from olpm_bench.transport.settings import InputError


def test_exr_is_exact(tmp_path):
    pixels = np.float32([[[1e-30, 6.5e4, 1e20]]]) * np.ones((3, 2, 3), np.float32)
    write_exr(tmp_path / "x.exr", {"mean": pixels}, {"text": 'ä "b"', "number": 0.1})
    parts, header = read_exr(tmp_path / "x.exr")
    np.testing.assert_array_equal(parts["mean"], pixels)
    assert header == {"text": 'ä "b"', "number": 0.1}


def test_images_larger_than_memory_are_refused_before_they_are_unpacked(tmp_path, monkeypatch):
    """A black image of 12 MB is a file of some kB."""
    path = tmp_path / "black.exr"
    write_exr(path, {"mean": np.zeros((1000, 1000, 3), np.float32)})
    assert path.stat().st_size < 100_000
    monkeypatch.setattr(headroom, "free", lambda: 3e7)
    with pytest.raises(InputError, match=r"black.exr: its images take about 0.036 GB, and 0.03 GB are free"):
        read_exr(path)


# ---------------------------------------------------------------- other programs

RNG = np.random.default_rng(4)
MEAN, VARIANCE, COUNT = RNG.random((5, 7, 3), np.float32), RNG.random((5, 7, 3), np.float32), RNG.random((5, 7), np.float32)
REFERENCES = Path(__file__).resolve().parents[2] / "results" / "references"


@pytest.fixture
def ours(tmp_path) -> Path:
    write_exr(tmp_path / "ours.exr", {"mean": MEAN, "variance": VARIANCE, "count": COUNT}, {"seed": 3})
    return tmp_path / "ours.exr"


def test_layers_come_back_by_name_and_in_order(ours):
    images, header = read_exr(ours)
    assert list(images) == ["mean", "variance", "count"] and header == {"seed": 3}
    for image, written in zip(images.values(), (MEAN, VARIANCE, COUNT[..., None]), strict=True):
        np.testing.assert_array_equal(image, written)


def test_the_file_is_one_part_with_layers(ours):
    import OpenEXR
    parts = OpenEXR.File(str(ours), separate_channels=True).parts
    assert len(parts) == 1
    assert set(parts[0].channels) == {"R", "G", "B", "variance.R", "variance.G", "variance.B", "count.Y"}


def test_mitsuba_opens_our_files(ours):
    import mitsuba as mi
    layers = {name: np.array(image) for name, image in mi.Bitmap(str(ours)).split()}
    np.testing.assert_array_equal(layers["<root>"], MEAN)
    np.testing.assert_array_equal(layers["variance"], VARIANCE)


def test_simpleimageio_opens_our_files(ours):
    simpleimageio = pytest.importorskip("simpleimageio")
    np.testing.assert_array_equal(simpleimageio.read(str(ours)), MEAN)
    layers = simpleimageio.read_layered_exr(str(ours))
    np.testing.assert_array_equal(layers["variance"], VARIANCE)


def test_openimageio_opens_our_files(ours):
    oiio = pytest.importorskip("OpenImageIO")
    opened = oiio.ImageInput.open(str(ours))
    assert opened.spec().channelnames[:3] == ("R", "G", "B")
    np.testing.assert_array_equal(opened.read_image("float")[..., :3], MEAN)


def write_parts(path: Path, parts: list[tuple[str, dict[str, np.ndarray]]]) -> Path:
    """An EXR of another program: a name and channels for each part."""
    import OpenEXR
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File([OpenEXR.Part(dict(header), dict(channels), name) for name, channels in parts]).write(str(path))
    return path


def channels(prefix: str, image: np.ndarray, names: str = "RGB") -> dict[str, np.ndarray]:
    return {prefix + name: np.ascontiguousarray(image[..., i]) for i, name in enumerate(names)}


DEPTH = {"ViewLayer.Depth.Z": COUNT}
BLENDER = channels("ViewLayer.Combined.", MEAN) | {"ViewLayer.Combined.A": COUNT}
ALBEDO = channels("ViewLayer.Albedo.", VARIANCE)
CRYPTOMATTE = channels("ViewLayer.CryptoObject00.", VARIANCE, "rgb")


@pytest.mark.parametrize("parts", [
    [("", ALBEDO | CRYPTOMATTE | DEPTH | BLENDER)],                                                 # Blender up to 4
    [("ViewLayer.Albedo", ALBEDO), ("ViewLayer.Depth", DEPTH), ("ViewLayer.Combined", BLENDER)],    # from 5
    [("ViewLayer.Albedo", channels("", VARIANCE)), ("ViewLayer.Combined", channels("", MEAN))],
    [("", channels("", MEAN) | {"A": COUNT} | channels("albedo.", VARIANCE))],
    [("", channels("", MEAN.astype(np.float16).astype(np.float32)))],
], ids=["layers", "parts with layers", "parts", "root and layer", "root"])
def test_the_image_of_another_renderer_is_what_it_shows(tmp_path, parts):
    images, header = read_exr(write_parts(tmp_path / "theirs.exr", parts))
    assert header == {} and not any("Depth" in name for name in images)
    np.testing.assert_allclose(next(iter(images.values())), MEAN, atol=1e-3)
    np.testing.assert_allclose(read_reference(tmp_path / "theirs.exr", 7, 5).mean, MEAN, atol=1e-3)


def test_half_floats_are_read(tmp_path):
    path = write_parts(tmp_path / "half.exr", [("", {k: v.astype(np.float16) for k, v in BLENDER.items()})])
    image, = read_exr(path)[0].values()
    assert image.dtype == np.float32
    np.testing.assert_allclose(image, MEAN, atol=1e-3)


@pytest.mark.parametrize("channels", [DEPTH, {"Y": COUNT, "RY": COUNT, "BY": COUNT}])
def test_a_file_without_an_image_is_refused(tmp_path, channels):
    with pytest.raises(ResultError, match="no RGB or Y channel"):
        read_exr(write_parts(tmp_path / "depth.exr", [("", channels)]))


def test_files_of_several_parts_as_we_wrote_them_are_read():
    import OpenEXR
    path = REFERENCES / "cornell_box-32x32-09435256" / "reference.exr"
    assert len(OpenEXR.File(str(path), header_only=True).parts) == 4
    images, header = read_exr(path)                 # its digest holds, too
    assert list(images) == ["a.mean", "b.mean", "a.variance", "b.variance"] and header["spp_a"] > 0
    assert all(image.shape == (32, 32, 3) for image in images.values())


def test_images_of_several_sizes_are_refused(tmp_path):
    with pytest.raises(ValueError, match="images of several sizes"):
        write_exr(tmp_path / "x.exr", {"a": MEAN, "b": MEAN[1:]})
