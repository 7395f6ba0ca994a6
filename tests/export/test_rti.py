"""One view as a relightable image, decoded as OpenLIME's shader does."""

import json

import numpy as np
import pytest
from PIL import Image

from reflfield.capture.encoding import encode_srgb
from reflfield.capture.lights import DirectionalLight
from reflfield.errors import InputError
from reflfield.export.formats import export_field
from reflfield.export.rti import _write_jpeg, image_planes, view_camera
from reflfield.render.camera_rays import FieldSurface
from reflfield.render.renderer import render
from tests.export.test_texture_layers import layers
from tests.synthetic_fields import baked_field, blinn_phong, lambert, square_surface


def weights(info, light):
    """Weights of mean and components for a light: ``BLN.lightWeights`` of ShaderRTI.js."""
    side = info["resolution"]
    n_planes = info["nplanes"]
    stored = np.array(info["basis"], np.uint8).reshape(n_planes + 1, side, side, 3)
    basis = np.zeros(stored.shape)
    basis[0] = stored[0] / 255
    ranges = np.array(info["materials"][0]["range"])
    basis[1:] = (stored[1:] - 127.0) / ranges[:, None, None, None]
    x, y, z = light
    total = abs(x) + abs(y) + abs(z)
    x, y = ((x + y) / total + 1) / 2 * (side - 1), ((y - x) / total + 1) / 2 * (side - 1)
    sx, sy = (min(side - 2, max(0, int(np.floor(v)))) for v in (x, y))
    dx, dy = x - sx, y - sy
    return (
        (1 - dx) * (1 - dy) * basis[:, sy, sx] + dx * (1 - dy) * basis[:, sy, sx + 1]
        + (1 - dx) * dy * basis[:, sy + 1, sx] + dx * dy * basis[:, sy + 1, sx + 1]
    )  # fmt: skip


def shown(folder, light):
    info = json.loads((folder / "info.json").read_text())
    base = weights(info, light)
    material = info["materials"][0]
    image = np.zeros((info["height"], info["width"], 3)) + base[0]
    for number in range(info["nplanes"] // 3):
        plane = np.asarray(Image.open(folder / f"plane_{number}.jpg")) / 255.0
        for k in range(3):
            p = 3 * number + k
            value = (plane[..., k] - material["bias"][p]) * material["scale"][p]
            image += base[p + 1] * value[..., None]
    return image


@pytest.fixture(scope="module")
def glossy():
    """A square of 24 x 24 texels, every other of its upper half tilted to the right, glossy."""
    surface = square_surface(24)
    c, s = np.cos(0.4), np.sin(0.4)
    surface.base_from_world[: 12 * 24 : 2] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    samples = blinn_phong([0.6, 0.3, 0.1], 0.4, 12.0)
    return baked_field(surface, samples, metadata={"up": [0.0, 0.0, 1.0]})


LIGHTS = np.array(
    [[0.0, 0.0, 1.0], [0.1, 0.2, 0.974679], [-0.5, 0.3, 0.812404], [0.3, -0.6, 0.74162]]
)


def off_field(field, images):
    """Encoded images under `LIGHTS`, less what the field shows."""
    camera = view_camera(FieldSurface(field))
    assert (camera.width, camera.height) == (24, 24)
    off = []
    for shown_image, light in zip(images, LIGHTS, strict=True):
        image = render(field, camera, DirectionalLight(light, np.pi)).image
        # The white is that of all lights of the grid; compared up to it.
        white = (image * shown_image**2.2).sum() / (shown_image**4.4).sum()
        off.append(shown_image - np.asarray(encode_srgb(np.clip(image / white, 0, 1))))
    return off


@pytest.mark.reference
def test_the_viewer_shows_what_the_field_does(glossy, tmp_path):
    export_field(glossy, tmp_path / "out", "rti")
    off = off_field(glossy, [shown(tmp_path / "out", light) for light in LIGHTS])
    for one in off:
        # Lights of the grid are 15 degrees apart: values between them are interpolated.
        assert np.sqrt(np.mean(one**2)) < 0.03
    # Light from the viewer is one of the grid: observed 0.0017, and 0.0067 between four.
    assert np.sqrt(np.mean(off[0] ** 2)) < 0.003


@pytest.mark.reference
def test_openlime_draws_what_is_decoded_here_and_the_field(glossy, tmp_path, openlime):
    export_field(glossy, tmp_path / "out", "rti")
    images = openlime(tmp_path / "out", LIGHTS[:, :2])
    for image, light in zip(images, LIGHTS, strict=True):
        decoded = 255 * np.clip(shown(tmp_path / "out", light), 0, 1)
        # Half a step of rounding; sums of single precision beside it, observed 2e-3.
        assert np.abs(image - decoded).max() < 0.51
    for off in off_field(glossy, images / 255):
        assert np.sqrt(np.mean(off**2)) < 0.03  # as above


def test_openlime_shows_the_normals(glossy, tmp_path, openlime):
    export_field(glossy, tmp_path / "out", "rti")
    drawn = openlime(tmp_path / "out", [[0.0, 0.0]], "normals")[0]
    x, y, z = np.moveaxis(written_normals(tmp_path / "out"), 2, 0)
    # Earlier versions of OpenLIME show z and y alone, as green and blue.
    ways = [np.stack([x, y, z], axis=2), np.stack([-np.ones_like(x), z, y], axis=2)]
    off = min(np.abs(drawn - 127.5 * (way + 1)).max() for way in ways)
    # Rounded in the file and on the screen, JPEG's steps of one between: observed 1.8.
    assert off < 3


def written_normals(folder):
    """Normals (height, width, 3) of ``normals.exr``."""
    read = layers(folder / "normals.exr")
    return np.stack([read[f"normal.{axis}"] for axis in "XYZ"], axis=2)


def test_normals_are_hardly_rounded_by_jpeg(glossy, tmp_path):
    export_field(glossy, tmp_path / "out", "rti")
    read = np.asarray(Image.open(tmp_path / "out" / "normals.jpg"))
    off = read - 127.5 * (written_normals(tmp_path / "out") + 1)
    # Rounding, steps of one in JPEG's frequencies, rounding again: each 0.29 steps.
    assert np.sqrt(np.mean(off**2)) < np.sqrt(3 / 12)


def test_channels_of_a_plane_do_not_blur_each_other(rng, tmp_path):
    """Coefficients are no colours: each channel is off as much as it is alone."""
    noise = rng.integers(0, 256, (64, 64, 3), np.uint8)
    read = _write_jpeg(tmp_path / "three.jpg", noise, 95)
    for channel in range(3):
        alone = np.repeat(noise[..., channel : channel + 1], 3, axis=2)
        wanted = _write_jpeg(tmp_path / "one.jpg", alone, 95)[..., 0]
        np.testing.assert_array_equal(read[..., channel], wanted)


def test_light_from_the_right_lights_what_faces_right(glossy, tmp_path):
    """x to the right: every other texel is tilted there."""
    export_field(glossy, tmp_path / "out", "rti")
    image = shown(tmp_path / "out", [0.7, 0.0, 0.71]).mean(axis=2)
    away = shown(tmp_path / "out", [-0.7, 0.0, 0.71]).mean(axis=2)
    assert image[:12, ::2].mean() > 1.2 * away[:12, ::2].mean()
    normals = written_normals(tmp_path / "out")[..., 0]
    # The fit moves the normals a little: observed 3e-5.
    np.testing.assert_allclose(normals[:12, ::2], np.sin(0.4), atol=1e-4)
    np.testing.assert_allclose(normals[12:], 0, atol=1e-4)  # likewise


def test_components_are_exact_to_their_rounding(rng):
    """Images of three components: what is decoded is off by the steps of bytes alone."""
    images = rng.uniform(size=(500, 3)) @ rng.uniform(size=(3, 16 * 3)) / 3
    planes = image_planes(images.reshape(500, 16, 3).astype(np.float32), 6)
    # Coefficients within half a step of 255 of their range, which is below 3; the mean too.
    assert np.abs(planes.decoded() - images.reshape(500, 16, 3)).max() < 4 / 255


def test_an_unknown_light_and_a_view_elsewhere_are_refused(tmp_path, glossy):
    field = baked_field(square_surface(2), lambert(0.5), light_side=1, light_model="unknown")
    with pytest.raises(InputError, match="unknown light"):
        export_field(field, tmp_path / "out", "rti")
    with pytest.raises(InputError, match="view"):
        export_field(glossy, tmp_path / "a.glb", "gltf", [0, 0, 1])
    with pytest.raises(InputError, match="folder, without a suffix"):
        export_field(glossy, tmp_path / "a.json", "rti")
    assert not list(tmp_path.iterdir())
