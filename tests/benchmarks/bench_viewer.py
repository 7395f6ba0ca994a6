"""The web page of a field: its size, its frames in a software renderer, its difference.

    python tests/benchmarks/bench_viewer.py out/field.rfld --size 640 480

Needs Chromium and Playwright (``pip install ".[test]"``). The software renderer is the same on
every machine and far slower than a graphics card; it says how two versions of the page compare.
"""

from __future__ import annotations

import argparse
import base64
import shutil
import statistics
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
from playwright.sync_api import sync_playwright
from scipy import ndimage

import reflfield as rf
from reflfield.field.reflectance_field import HalfVectorField
from reflfield.render.turntable import OrbitOptions, orbit_cameras
from reflfield.viewer.object_page import camera_values, light_values, object_page
from tests.viewer.conftest import FLAGS, NAMES

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
COMPARED_SIDE = 96


def fetches(stored):
    """Texture fetches of a fragment of four texels under one lamp, lit and in shadow."""
    n_indirect = len(stored.indirect.functions)
    if isinstance(stored, HalfVectorField):
        lit = 4 * (stored.half_vector.n_lobes + 3) + 1
    else:
        functions = stored.n_components + 1
        lit = 4 * (2 * functions + -(-functions // 4)) + 1
    return 4 + lit, 4 + n_indirect + 4 * -(-(n_indirect - 1) // 4) + 1


def difference(page, field):
    """Relative L2 difference from the library over pixels off the rim, and its median."""
    options = OrbitOptions(n_images=3, size=COMPARED_SIDE, up=tuple(field.up))
    rows = []
    for camera in orbit_cameras(field.stored.positions, options):
        light = rf.DirectionalLight(camera.up + 0.5 * np.cross(camera.up, camera.forward))
        wanted = field.render(camera, light, alpha=True)
        text = page.evaluate(
            "(given) => reflfield.renderTest(...given)",
            [camera_values(camera), [light_values(light)]],
        )
        shown = np.frombuffer(base64.b64decode(text), np.float32).reshape(wanted.shape)
        inside = ndimage.binary_erosion(wanted[..., 3] == 1, iterations=2)
        off = (shown - wanted)[inside][:, :3]
        size = np.linalg.norm(wanted[inside][:, :3])
        rows.append((np.linalg.norm(off) / size, np.median(np.abs(off)) / wanted.max()))
    return np.array(rows)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("field", type=Path)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480))
    parser.add_argument("--frames", type=int, default=5)
    arguments = parser.parse_args()
    field = rf.open_field(arguments.field)
    html = object_page(field.stored)
    first = html.index('id="block-1"')
    print(f"page {len(html) / 1e6:.2f} MB, first picture after {first / 1e6:.2f} MB")
    print("fetches under one lamp: {} lit, {} in shadow".format(*fetches(field.stored)))
    path = next(filter(None, map(shutil.which, NAMES)))
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        (Path(folder) / "object.html").write_text(html, encoding="utf-8")
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        width, height = arguments.size
        page = browser.new_page(
            viewport={"width": width, "height": height}, reduced_motion="reduce"
        )
        started = time.perf_counter()
        page.goto((Path(folder) / "object.html").as_uri())
        page.evaluate("reflfield.ready")
        print(f"ready after {time.perf_counter() - started:.2f} s")
        for name in ("none", "studio"):
            times = [page.evaluate(FRAME, name) for _ in range(arguments.frames + 1)][1:]
            print(f"frame, surroundings {name}: {statistics.median(times):.0f} ms")
        for relative, median in difference(page, field):
            print(f"difference: relative L2 {relative:.4f}, median {median:.1e} of the largest")
        browser.close()


if __name__ == "__main__":
    main()
