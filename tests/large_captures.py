"""Captures whose photographs are made large, to measure memory: every pixel many times."""

import json

import cv2
import numpy as np

from reflfield.capture.encoding import encode_srgb
from reflfield.capture.image_files import read_image


def enlarged_capture(source, target, side, views=(0, 3, 4, 8), lights=(0, 1)):
    """Write some views and lights of a simulated capture, square, with `side` pixels, 8-bit."""
    document = json.loads((source / "capture.json").read_text())
    document.pop("truth", None)
    document["cameras"] = [document["cameras"][i] for i in views]
    document["lights"] = [document["lights"][i] for i in lights]
    document["photographs"] = []
    for name in ("photographs", "silhouettes"):
        (target / name).mkdir(parents=True)
    for camera in document["cameras"]:
        scale = side / camera["w"]
        for key in ("w", "h", "fl_x", "fl_y", "cx", "cy"):
            camera[key] = type(camera[key])(camera[key] * scale)
        mask = cv2.imread(str(source / camera["silhouette"]), cv2.IMREAD_GRAYSCALE)
        _write(target / camera["silhouette"], mask, side)
        for light in document["lights"]:
            name = f"photographs/{camera['id']}_{light['id']}"
            codes = encode_srgb(read_image(source / f"{name}.exr")) * 255
            _write(target / f"{name}.png", np.clip(codes, 1, 254).astype(np.uint8), side)
            document["photographs"].append(
                {"camera": camera["id"], "light": light["id"], "file": f"{name}.png"}
            )
    (target / "capture.json").write_text(json.dumps(document))


def _write(path, picture, side):
    """Write an 8-bit picture with `side` pixels a side, hardly compressed."""
    large = cv2.resize(picture, (side, side), interpolation=cv2.INTER_NEAREST)
    cv2.imwrite(str(path), large[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
