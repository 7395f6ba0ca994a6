"""A whole run of large photographs keeps below the ceiling that it says would suffice."""

import json
import re
import shutil

import cv2
import numpy as np
import pytest

from reflfield.capture.encoding import encode_srgb
from reflfield.capture.image_files import read_image

SIDE = 1400
VIEWS, LIGHTS = (0, 3, 4, 8), (0, 1)


def enlarged(path, picture):
    """Write an 8-bit picture with `SIDE` pixels a side, hardly compressed."""
    large = cv2.resize(picture, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST)
    cv2.imwrite(str(path), large, [cv2.IMWRITE_PNG_COMPRESSION, 1])


@pytest.fixture(scope="module")
def large_capture(tiny_capture, tmp_path_factory):
    """Four views and two lights of the tiny capture, every pixel many times as large."""
    folder = tmp_path_factory.mktemp("large")
    document = json.loads((tiny_capture / "capture.json").read_text())
    document.pop("truth", None)
    document["cameras"] = [document["cameras"][i] for i in VIEWS]
    document["lights"] = [document["lights"][i] for i in LIGHTS]
    document["photographs"] = []
    for name in ("photographs", "silhouettes"):
        (folder / name).mkdir()
    for camera in document["cameras"]:
        scale = SIDE / camera["w"]
        for key in ("w", "h", "fl_x", "fl_y", "cx", "cy"):
            camera[key] = type(camera[key])(camera[key] * scale)
        mask = cv2.imread(str(tiny_capture / camera["silhouette"]), cv2.IMREAD_GRAYSCALE)
        enlarged(folder / camera["silhouette"], mask)
        for light in document["lights"]:
            name = f"photographs/{camera['id']}_{light['id']}"
            radiance = read_image(tiny_capture / f"{name}.exr")
            codes = np.clip(encode_srgb(radiance) * 255, 1, 254).astype(np.uint8)
            enlarged(folder / f"{name}.png", codes[..., ::-1])
            document["photographs"].append(
                {"camera": camera["id"], "light": light["id"], "file": f"{name}.png"}
            )
    (folder / "capture.json").write_text(json.dumps(document))
    yield folder
    shutil.rmtree(folder)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["clustered", "half_vector"])
def test_large_frames_keep_below_the_ceiling_that_is_asked_for(
    large_capture, tiny_options, subprocess_run, tmp_path, model
):
    def run(ceiling):
        return subprocess_run(
            *("-m", "reflfield.cli", "run", large_capture, "-o", tmp_path / "out"),
            *("--config", tiny_options, "--hold-out", "photographs=1"),
            *("--max-memory", ceiling, "--set", "comparison.without_alignment=false"),
            *("--set", f"compression.model={model}"),
            *("--set", "comparison.rate_distortion=false"),
        )

    refused = run("1GB")
    assert refused.status == 2
    asked = re.search(r"--max-memory: expected at least (\d+\.\d) GB", refused.err)
    assert asked, refused.err
    assert run(f"{asked[1]}GB").status == 0
    timings = json.loads((tmp_path / "out" / "timings.json").read_text())
    ceiling = float(asked[1]) * 2**30
    assert timings["max_memory"] == pytest.approx(ceiling, rel=1e-6)
    # The libraries alone take 400 MB, so that the watch has seen something.
    assert 400e6 < timings["peak_bytes"] <= ceiling
