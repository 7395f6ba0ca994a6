"""The splits as the loaders of NRHints and GS3 read them: their code, not ours.

It is not shipped here. ``NRHINTS`` names a checkout of https://github.com/iamNCJ/NRHints,
``GS3`` one of https://github.com/gsrelight/gs-relight. Of what their modules import, this needs
``imageio`` and ``cv2``; the rest is replaced by mocks, as it takes no part in reading.
"""

import importlib
import json
import os
import sys
from types import ModuleType, SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import OpenEXR
import pytest
import trimesh
from PIL import Image
from scipy import ndimage

from capture_sim.write import write_capture
from reflfield.capture.encoding import encode_srgb
from reflfield.capture.readers import open_capture
from tests.capture_sim.test_write import scene

MOCKED = ("torch", "tyro", "plyfile", "utils.sh_utils", "scene.gaussian_model")


@pytest.fixture(scope="module")
def splits(tmp_path_factory):
    """Folder of the splits of a dome, what reflfield reads of it, and the true surface."""
    folder = tmp_path_factory.mktemp("captures") / "dome"
    rings = {
        "preset": "rings", "elevations_deg": [20, 50], "counts": [4, 2],
        "target": [0, 0, 0.1], "width": 96, "height": 80,
    }  # fmt: skip
    write_capture(
        scene(cameras=rings, effects={}, heldout={"photographs": 5}), folder, as_transforms=True
    )
    return SimpleNamespace(
        folder=folder / "transforms",
        ours=open_capture(folder / "transforms", test_split=True),
        points=np.asarray(trimesh.load_mesh(folder / "truth" / "mesh.ply").vertices),
    )


@pytest.fixture
def module_of(monkeypatch):
    """Function from a variable and a module's name to that module; skips where it is unset."""

    def imported(variable, name):
        root = os.environ.get(variable)
        if root is None:
            pytest.skip(f"needs code of others (set {variable} to its checkout)")
        monkeypatch.syspath_prepend(root)
        for mocked in MOCKED:
            monkeypatch.setitem(sys.modules, mocked, MagicMock())
        if name.startswith("scene."):  # whose __init__ imports the whole of the training
            package = ModuleType("scene")
            package.__path__ = [f"{root}/scene"]
            monkeypatch.setitem(sys.modules, "scene", package)
        kept = set(sys.modules)
        module = importlib.import_module(name)
        new.update(set(sys.modules) - kept)
        return module

    new = set()
    yield imported
    for name in new:
        if name.split(".")[0] in ("camera", "data", "scene", "utils"):
            del sys.modules[name]


def inverse(pose):
    """World to camera of a rigid camera to world."""
    rotation = pose[:3, :3].T
    return np.block([[rotation, -rotation @ pose[:3, 3:]], [np.zeros((1, 3)), 1]])


@pytest.fixture
def by_nrhints(splits, module_of):
    """What NRHints holds of each image, in the order of ours."""
    parser = module_of("NRHINTS", "data.data_parser")
    writer = parser.parse_load_nr_data(splits.folder, white_background=True)
    images, poses, lights = (np.array(one) for one in writer.get_shm_arrays())
    camera, counts = writer.camera, writer.num_image_per_split
    writer.release_shm()
    opencv_from_opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    return SimpleNamespace(
        counts=counts,
        images=images,
        camera_from_world=[opencv_from_opengl @ inverse(pose) for pose in poses],
        intrinsics=[(camera.cx, camera.cy, camera.fx, camera.fy)] * len(images),
        lights=lights,
    )


@pytest.fixture
def by_gs3(splits, module_of, monkeypatch):
    """What GS3 holds of each image, in the order of ours."""
    readers = module_of("GS3", "scene.dataset_readers")
    # It makes images of signed bytes, which Pillow once took for what they are in memory.
    opens = SimpleNamespace(
        open=Image.open, fromarray=lambda pixels, _: Image.fromarray(pixels.view(np.uint8))
    )
    monkeypatch.setattr(readers, "Image", opens)
    focal = importlib.import_module("utils.graphics_utils").fov2focal
    each = [
        readers.readCamerasFromTransforms(str(splits.folder), name, True, -1)
        for name in ("transforms_train.json", "transforms_test.json")
    ]
    read = [*each[0], *each[1]]
    return SimpleNamespace(
        counts=[len(each[0]), 0, len(each[1])],
        images=np.stack([np.asarray(one.image) / 255 for one in read]),
        camera_from_world=[
            np.block([[one.R.T, one.T[:, None]], [np.zeros((1, 3)), 1]]) for one in read
        ],
        intrinsics=[
            (one.cx, one.cy, focal(one.FovX, one.width), focal(one.FovY, one.height))
            for one in read
        ],
        lights=np.array([one.pl_pos for one in read]),
    )


@pytest.fixture(params=["by_nrhints", "by_gs3"])
def read(request):
    """What one of the two loaders read."""
    return request.getfixturevalue(request.param)


# What their code does with new versions of its libraries: bytes from floats above 127.
pytestmark = pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")


def truth_of(splits, index):
    """Radiance over black, and coverage, of the OpenEXR image of a frame."""
    path = splits.ours.photographs[index].path
    with OpenEXR.File(str(path)) as file:
        pixels = file.channels()["RGBA"].pixels.astype(np.float64)
    return pixels[..., :3], pixels[..., 3]


def test_every_photograph_is_there_once(splits, read):
    n_test = sum(one.is_test for one in splits.ours.photographs)
    assert n_test == 5
    assert list(read.counts) == [len(splits.ours.photographs) - n_test, 0, n_test]


def test_images_are_those_of_the_capture_on_white(splits, read):
    white = json.loads((splits.folder / "transforms_train.json").read_text())["png_white"]
    for index, image in enumerate(read.images):
        radiance, alpha = truth_of(splits, index)
        straight = radiance / np.where(alpha > 0, alpha, 1)[..., None]
        encoded = np.asarray(encode_srgb(np.clip(straight / white, 0, 1)))
        wanted = alpha[..., None] * encoded + 1 - alpha[..., None]
        # Rounding to bytes of colour and alpha, half a step each; GS3 then truncates.
        assert np.abs(image - wanted).max() < 2.1 / 255


def test_cameras_and_lights_are_those_of_the_capture(splits, read):
    for index, photograph in enumerate(splits.ours.photographs):
        camera = splits.ours.cameras[photograph.camera]
        light = splits.ours.lights[photograph.light]
        # NRHints keeps single precision.
        np.testing.assert_allclose(
            read.camera_from_world[index], camera.camera_from_world, atol=1e-6
        )
        np.testing.assert_allclose(read.lights[index], light.position, rtol=1e-6)  # likewise
        lengths = (camera.cx, camera.cy, camera.fl_x, camera.fl_y)
        # GS3 keeps an angle for a length, in double precision.
        np.testing.assert_allclose(read.intrinsics[index], lengths, rtol=1e-12)


def test_their_cameras_see_the_surface_where_the_images_show_it(splits, read):
    for index, pose in enumerate(read.camera_from_world):
        cx, cy, fx, fy = read.intrinsics[index]
        x, y, z = (splits.points @ pose[:3, :3].T + pose[:3, 3]).T
        column, row = cx + fx * x / z, cy + fy * y / z
        covered = truth_of(splits, index)[1] > 0
        near = ndimage.binary_dilation(covered)
        assert near[row.astype(int), column.astype(int)].all()
        rows, columns = np.nonzero(covered)
        # The outline's pixels are those that the outermost points lie in, within one.
        np.testing.assert_allclose([row.min(), row.max()], [rows.min(), rows.max() + 1], atol=1)
        seen = [columns.min(), columns.max() + 1]
        np.testing.assert_allclose([column.min(), column.max()], seen, atol=1)  # likewise
