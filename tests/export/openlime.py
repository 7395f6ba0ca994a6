"""OpenLIME in a browser without a window: what it draws of an exported folder.

OpenLIME is not shipped with this project. ``OPENLIME`` names its script, as
``dist/js/openlime.js`` of https://github.com/cnr-isti-vclab/openlime or
``demo/openlime.js`` of https://github.com/cnr-isti-vclab/relight.
"""

import base64
import functools
import io
import json
import os
import shutil
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
from PIL import Image

# The canvas is as large as the image: a pixel of the one is a pixel of the other.
PAGE = """<!DOCTYPE html><style>body {{ margin: 0 }}
.openlime, .openlime > canvas {{ display: block; width: {width}px; height: {height}px }}</style>
<div class="openlime"></div><script src="openlime.js"></script><script>
const viewer = new OpenLIME.Viewer(
  ".openlime", {{ canvas: {{ preserveDrawingBuffer: true }} }});
const layer = new OpenLIME.Layer(
  {{ type: "rti", url: "info.json", layout: "image", normals: true }});
viewer.addLayer("rti", layer);
const painted = () => new Promise((done) => requestAnimationFrame(() =>
  requestAnimationFrame(() => requestAnimationFrame(done))));
const loaded = () => layer.status === "ready" && layer.tiles.get(0)?.missing === 0;
async function shown(mode, light) {{
  if (mode !== layer.getMode()) layer.setMode(mode);
  layer.setLight(light, 0);
  await painted();
  return viewer.canvasElement.toDataURL("image/png");
}}
</script>"""


class QuietHandler(SimpleHTTPRequestHandler):
    """Serves a folder without a line for each request."""

    def log_message(self, format, *args):
        """Say nothing."""


def openlime_script():
    """Path of OpenLIME's script, or None where ``OPENLIME`` is not set."""
    path = os.environ.get("OPENLIME")
    return Path(path) if path else None


def openlime_images(browser, folder, work, lights, mode="light"):
    """Images that OpenLIME draws, (n, height, width, 3) uint8.

    Parameters
    ----------
    browser : playwright.sync_api.Browser
    folder : Path
        As ``export --to rti`` writes it.
    work : Path
        An empty folder to serve from.
    lights : (n, 2) array_like
        Directions to the lamps: right and up.
    mode : str
        Of ``ShaderRTI``: "light" or "normals".
    """
    info = json.loads((folder / "info.json").read_text())
    shutil.copytree(folder, work, dirs_exist_ok=True)
    shutil.copy(openlime_script(), work / "openlime.js")
    size = {key: info[key] for key in ("width", "height")}
    (work / "index.html").write_text(PAGE.format(**size))
    server = ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(QuietHandler, directory=str(work))
    )
    threading.Thread(target=server.serve_forever, daemon=True).start()
    page = browser.new_page(viewport=size)
    try:
        page.goto(f"http://127.0.0.1:{server.server_port}/index.html")
        page.wait_for_function("loaded()")
        urls = [
            page.evaluate("(given) => shown(...given)", [mode, list(map(float, light))])
            for light in lights
        ]
    finally:
        page.close()
        server.shutdown()
        server.server_close()
    return np.stack([_pixels(url) for url in urls])


def _pixels(url):
    encoded = base64.b64decode(url.partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(encoded)).convert("RGB"))
