"""The web page of fields: size, frames in a software renderer, difference from the library.

    python tests/benchmarks/bench_viewer.py demo=out/field.rfld lion=lion/field.rfld

Needs Chromium and Playwright (``pip install ".[test]"``). The software renderer is the same on
every machine and far slower than a graphics card; it says how two versions of the page compare.

The difference is that of three images by the page and by the library, under one distant light:
over all pixels inside the object, and over those that no edge of a shadow, of the object or of
a part of it before another is near to (within 2 pixels): there the page has another resolution.
Beside it is the difference of the library's image from one moved by 1/100 of a pixel: texels
smaller than pixels are sampled, and rasterisers place vertices to 1/256 of a pixel only.
Writes results/viewer.json.
"""

from __future__ import annotations

import argparse
import base64
import json
import shutil
import statistics
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parents[1])]

import numpy as np  # noqa: E402
from benchmarks.measuring import Results  # noqa: E402
from playwright.sync_api import sync_playwright  # noqa: E402
from scipy import ndimage  # noqa: E402

import reflfield as rf  # noqa: E402
from reflfield.field.reflectance_field import HalfVectorField  # noqa: E402
from reflfield.geometry.mesh import Mesh  # noqa: E402
from reflfield.geometry.ray_scene import RayScene  # noqa: E402
from reflfield.render.camera_rays import subpixel_offsets  # noqa: E402
from reflfield.render.turntable import OrbitOptions, orbit_cameras  # noqa: E402
from reflfield.viewer.object_page import camera_values, light_values, object_page  # noqa: E402
from tests.viewer.conftest import FLAGS, NAMES  # noqa: E402

# Draws one frame and waits for it: reading a pixel back ends the work of the card.
FRAME = """(name) => {
  const v = reflfield.viewer(), gl = v.painter.gl, started = performance.now();
  v.refine = function () { this.refining = null; };
  v.movingScale = 1;
  v.scene.camera.azimuth += 0.05;
  if (v.scene.map.name !== name) reflfield.act.map(name);
  v.drawMoving();
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  return performance.now() - started;
}"""
COMPARED_SIDE = 192
RAYS = subpixel_offsets(16).tolist()
# Pixels around edges; shares of the object's size by which one part lies before another, and by
# which rays to the light start above the surface.
EDGE_PX, DEPTH_JUMP, LIFT = 2, 0.02, 1e-4
MOVED_PX = 0.01
# Degrees above the horizon from which flat objects are looked at, and others.
ABOVE_FLAT, ABOVE = 60, OrbitOptions().elevation_deg


def fetches(stored):
    """Texture fetches of a fragment of four texels under one lamp, lit and in shadow."""
    n_indirect = len(stored.indirect.functions)
    if isinstance(stored, HalfVectorField):
        lit = 4 * (stored.half_vector.n_lobes + 3) + 1
    else:
        functions = stored.n_components + 1
        lit = 4 * (2 * functions + -(-functions // 4)) + 1
    return 4 + lit, 4 + n_indirect + 4 * -(-(n_indirect - 1) // 4) + 1


def away_from_edges(scene, camera, light):
    """Pixels (height, width) that no edge of the object, of a part or a shadow is near to."""
    shape = (camera.height, camera.width)
    lit, dark, near, far = (np.full(shape, value) for value in (False, False, np.inf, -np.inf))
    for offset in subpixel_offsets(16):
        depth, shadowed = seen(scene, camera, light, offset)
        lit |= ~shadowed
        dark |= shadowed
        near, far = np.minimum(near, depth), np.maximum(far, depth)
    window = 2 * EDGE_PX + 1
    jump = ndimage.maximum_filter(far, window) - ndimage.minimum_filter(near, window)
    # Where the object ends, the jump is infinite.
    whole = np.isfinite(jump) & (jump < DEPTH_JUMP * scene.diagonal)
    shadows = [ndimage.binary_dilation(part, iterations=EDGE_PX) for part in (lit, dark)]
    return whole & ~(shadows[0] & shadows[1])


def seen(scene, camera, light, offset):
    """Depths (height, width) of points in the pixels, and which of them are in shadow."""
    rows, columns = np.mgrid[: camera.height, : camera.width]
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2) + offset
    origins, towards = camera.rays(pixels)
    depth, face, _ = scene.first_hit(origins, towards)
    normals = scene.mesh.face_normals[np.maximum(face, 0)]
    normals = normals * -np.sign(np.einsum("nd,nd->n", normals, towards))[:, None]
    points = origins + np.where(np.isfinite(depth), depth, 0)[:, None] * towards
    lamp = np.broadcast_to(light.directions(np.zeros((1, 3)))[0], points.shape)
    shadowed = scene.occluded(points + LIFT * scene.diagonal * normals, lamp)
    shadowed |= np.einsum("nd,nd->n", normals, lamp) <= 0
    return depth.reshape(camera.height, camera.width), shadowed.reshape(
        camera.height, camera.width
    )


def differences(page, field):
    """Relative L2 differences from the library, of all pixels and of those off the edges."""
    stored = field.stored
    sides = np.ptp(stored.positions, axis=0)
    is_flat = sides.min() == 0
    options = OrbitOptions(
        n_images=3,
        size=COMPARED_SIDE,
        up=tuple(np.eye(3)[sides.argmin()] if is_flat else field.up),
        elevation_deg=ABOVE_FLAT if is_flat else ABOVE,
    )
    scene = RayScene(Mesh(stored.positions, stored.faces))
    off, moved_off, wanted_all, kept = [], [], [], []
    for camera in orbit_cameras(stored.positions, options):
        light = rf.DirectionalLight(camera.up + 0.5 * np.cross(camera.up, camera.forward))
        wanted = field.render(camera, light, alpha=True)
        text = page.evaluate(
            "(given) => reflfield.renderTest(...given)",
            [camera_values(camera), [light_values(light)], RAYS],
        )
        shown = np.frombuffer(base64.b64decode(text), np.float32).reshape(wanted.shape)
        inside = ndimage.binary_erosion(wanted[..., 3] == 1, iterations=EDGE_PX)
        off.append((shown - wanted)[inside][:, :3])
        moved = replace(camera, cx=camera.cx + MOVED_PX, cy=camera.cy + MOVED_PX)
        moved_off.append((field.render(moved, light) - wanted[..., :3])[inside])
        wanted_all.append(wanted[inside][:, :3])
        kept.append(away_from_edges(scene, camera, light)[inside])
    off, moved_off, wanted, kept = map(np.concatenate, (off, moved_off, wanted_all, kept))
    return {
        "difference inside": float(np.linalg.norm(off) / np.linalg.norm(wanted)),
        "difference off the edges": float(
            np.linalg.norm(off[kept]) / np.linalg.norm(wanted[kept])
        ),
        "library moved by .01 pixels": float(
            np.linalg.norm(moved_off) / np.linalg.norm(wanted)
        ),
        "share off the edges": float(kept.mean()),
        "median difference": float(np.median(np.abs(off)) / wanted.max()),
    }


def measured(browser, name, path, size, n_frames):
    """Row of one field."""
    field = rf.open_field(path)
    html = object_page(field.stored)
    lit, in_shadow = fetches(field.stored)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "object.html").write_text(html, encoding="utf-8")
        page = browser.new_page(
            viewport={"width": size[0], "height": size[1]}, reduced_motion="reduce"
        )
        started = time.perf_counter()
        page.goto((Path(folder) / "object.html").as_uri())
        page.evaluate("reflfield.ready")
        row = {
            "field": name,
            "page, MB": len(html) / 1e6,
            "first picture after, MB": html.index('id="block-1"') / 1e6,
            "ready after, s": time.perf_counter() - started,
            "fetches, lit": lit,
            "fetches, in shadow": in_shadow,
        }
        for surroundings in ("none", "studio"):
            times = [page.evaluate(FRAME, surroundings) for _ in range(n_frames + 1)][1:]
            row[f"frame, surroundings {surroundings}, ms"] = statistics.median(times)
        row |= differences(page, field)
        page.close()
    return {
        key: float(f"{value:.3g}") if isinstance(value, float) else value
        for key, value in row.items()
    }


def named(text):
    """NAME=FILE, or a file that its folder names."""
    name, _, path = text.rpartition("=")
    return name or Path(path).resolve().parent.name, Path(path)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("fields", type=named, nargs="+", metavar="NAME=FIELD")
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480))
    parser.add_argument("--frames", type=int, default=5)
    arguments = parser.parse_args()
    results = Results("viewer", "Web page", ["reflfield.viewer.object_page"])
    results.table("Pages in a software renderer")
    path = next(filter(None, map(shutil.which, NAMES)))
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        for name, field in arguments.fields:
            row = measured(browser, name, field, arguments.size, arguments.frames)
            results.add(row)
            print(json.dumps(row), flush=True)
        browser.close()
    print(results.write())


if __name__ == "__main__":
    main()
