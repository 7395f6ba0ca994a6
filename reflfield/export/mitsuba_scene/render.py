"""Render an exported field with Mitsuba 3: ``python render.py --help``."""

from __future__ import annotations

import argparse
import importlib
import json
import math
from pathlib import Path
from typing import Any

import mitsuba as mi

HERE = Path(__file__).resolve().parent


def scene(
    camera: list[float],
    size: int,
    samples: int,
    light: list[float] | None,
    environment: str | None,
    depth: int = 6,
) -> dict[str, Any]:
    """Description of a scene, after the variant is set and the plug-in is imported.

    Camera and light are directions from the object; the light has an irradiance of pi. The
    camera comes nearer where its direction is shorter than 1.
    """
    about = json.loads((HERE / "scene.json").read_text())
    distance = about["distance"] * math.sqrt(sum(x * x for x in camera))
    pixel = 2.0 * distance * math.tan(math.radians(about["fov"]) / 2.0) / size
    blend = min(max(1.0 - pixel / about["texel_width"], 0.0), 1.0)
    to_world = mi.ScalarTransform4f().look_at(
        [about["distance"] * x for x in camera], [0.0, 0.0, 0.0], about["up"]
    )
    described: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth, "hide_emitters": True},
        "sensor": {
            "type": "perspective",
            "fov": about["fov"],
            "to_world": to_world,
            "sampler": {"type": "independent", "sample_count": samples},
            "film": {
                "type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"},
                "pixel_format": "rgba",
            },
        },
        "object": {
            "type": "ply",
            "filename": str(HERE / "object.ply"),
            "bsdf": {"type": "reflfield", "model": str(HERE / "model.npz"), "blend": blend},
        },
    }  # fmt: skip
    if environment is not None:
        # The map's zenith, +Y, to the field's up.
        turned = mi.ScalarTransform4f(about["world_from_environment"])
        described["sky"] = {"type": "envmap", "filename": environment, "to_world": turned}
    if light is not None or environment is None:
        towards = light or about["up"]
        described["light"] = {
            "type": "directional", "direction": [-x for x in towards],
            "irradiance": {"type": "rgb", "value": 3.14159265},
        }  # fmt: skip
    return described


def main() -> None:
    """Render one image."""
    about = json.loads((HERE / "scene.json").read_text())
    parser = argparse.ArgumentParser(description="Render an exported field with Mitsuba 3.")
    parser.add_argument("--out", default="image.exr", help="OpenEXR or PNG")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="or scalar_rgb")
    parser.add_argument("--camera", type=float, nargs=3, default=about["camera"])
    parser.add_argument("--light", type=float, nargs=3, help="direction to a distant light")
    parser.add_argument("--environment", help="latitude-longitude map")
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--samples", type=int, default=64, help="rays per pixel")
    asked = parser.parse_args()
    mi.set_variant(asked.variant)
    importlib.import_module("reflfield_bsdf")  # once the variant is set
    length = sum(x * x for x in asked.camera) ** 0.5
    camera = [x / length for x in asked.camera]
    described = scene(camera, asked.size, asked.samples, asked.light, asked.environment)
    mi.util.write_bitmap(asked.out, mi.render(mi.load_dict(described)))


if __name__ == "__main__":
    main()
