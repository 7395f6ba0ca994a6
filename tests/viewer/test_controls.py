"""Every control of the page, used as a person does, and what it says of what is wrong."""

import base64
import io
import re
import struct
import time
import zlib

import numpy as np
import pytest
from PIL import Image

import reflfield as rf
from reflfield.render.environment_map import EnvironmentMap
from reflfield.viewer.object_page import Bookmark, object_page
from tests.viewer.shown_fields import half_vector_field, planar_field

WINDOW = (900, 620)
NOT_REFINED = "() => { reflfield.viewer().refine = function () { this.refining = null; }; }"


@pytest.fixture(scope="module")
def html():
    picture = io.BytesIO()
    Image.new("RGB", (8, 6), (200, 100, 50)).save(picture, "PNG")
    camera = rf.Camera.look_at([0, -5, 1], width=80, height=60)
    bookmark = Bookmark("v00_l01", "Held out.", camera, (rf.PointLight([0, -5, 3], 20.0),),
                        0.5, picture.getvalue(), "image/png")  # fmt: skip
    return object_page(half_vector_field(), "two spheres", [bookmark])


@pytest.fixture(scope="module")
def only_page(html, open_shared_page):
    """The page at a small scale, so that the software renderer keeps up."""
    opened = open_shared_page(html, size=WINDOW)
    opened.evaluate("() => { reflfield.viewer().movingScale = 0.1; }")
    # What is refined once all is still is tested elsewhere.
    opened.evaluate(NOT_REFINED)
    return opened


@pytest.fixture
def page(only_page):
    """The page as it was when it was opened."""
    only_page.evaluate("reflfield.act.reset()")
    only_page.evaluate("document.querySelector('input[name=drag]').checked = true")
    only_page.evaluate("reflfield.act.panel(true)")
    settled(only_page)
    return only_page


def settled(page):
    """Wait until what was asked for is drawn."""
    while not page.evaluate("reflfield.viewer().isStill"):
        page.wait_for_timeout(20)


def scene(page):
    return page.evaluate("reflfield.viewer().scene")


def eventually(page, condition, seconds=20):
    """Wait until a condition of the page holds; its policy forbids to evaluate text inside."""
    end = time.monotonic() + seconds
    while not page.evaluate(condition):
        assert time.monotonic() < end, condition
        page.wait_for_timeout(20)


def drag(page, start, steps, **options):
    page.mouse.move(*start)
    page.mouse.down(**options)
    for step in steps:
        page.mouse.move(*step)
    page.mouse.up(**options)


class TestMouse:
    def test_drag_turns_wheel_zooms_right_drag_moves(self, page):
        before = scene(page)["camera"]
        drag(page, (200, 300), [(230, 320), (260, 340)])
        turned = scene(page)["camera"]
        assert turned["azimuth"] < before["azimuth"]
        assert turned["elevation"] > before["elevation"]
        page.mouse.wheel(0, 300)
        settled(page)
        zoomed = scene(page)["camera"]
        assert zoomed["distance"] > 1.2 * before["distance"]
        drag(page, (200, 300), [(240, 300)], button="right")
        moved = scene(page)["camera"]
        assert moved["target"] != before["target"]
        assert moved["azimuth"] == zoomed["azimuth"]

    def test_dot_of_a_light_follows_the_pointer_and_goes_behind_beyond_the_rim(self, page):
        dot = page.locator(".lamp-handle").first
        box = dot.bounding_box()
        start = (box["x"] + 22, box["y"] + 22)
        drag(page, start, [(start[0] - 30, start[1] + 40), (start[0] - 60, start[1] + 60)])
        settled(page)
        after = dot.bounding_box()
        row = 1  # pointers stand on whole pixels
        assert after["x"] + 22 == pytest.approx(start[0] - 60, abs=row)
        assert after["y"] + 22 == pytest.approx(start[1] + 60, abs=row)
        assert "behind" not in dot.get_attribute("class")
        middle = page.evaluate("(() => { const v = reflfield.viewer();"
                               " return v.free(innerWidth, innerHeight); })()")  # fmt: skip
        end = (middle[0] + middle[2] + 60, 300)
        drag(page, (after["x"] + 22, after["y"] + 22), [(400, 300), end])
        settled(page)
        assert "behind" in dot.get_attribute("class")

    def test_shift_drag_and_the_choice_move_the_light(self, page):
        before = scene(page)
        page.keyboard.down("Shift")
        drag(page, (200, 300), [(260, 300)])
        page.keyboard.up("Shift")
        shifted = scene(page)
        assert shifted["lamps"][0]["azimuth"] > before["lamps"][0]["azimuth"]
        page.locator("input[name=drag][value=light]").check(force=True)
        drag(page, (200, 300), [(260, 260)])
        chosen = scene(page)
        assert chosen["lamps"][0]["elevation"] > shifted["lamps"][0]["elevation"]
        assert chosen["camera"] == before["camera"]


class TestPanel:
    def test_lights(self, page):
        page.locator("#lamp-2-on").check()
        page.locator("#lamp-2-colour").fill("#ff8040")
        page.locator("#lamp-2-distance").fill("2")
        page.locator("#lamp-2-strength").fill("1.5")
        lamp = scene(page)["lamps"][1]
        assert (lamp["on"], lamp["colour"]) == (True, "#ff8040")
        assert (lamp["distance"], lamp["strength"]) == (2, 1.5)
        page.locator("#flash-on").check()
        assert scene(page)["flash"]
        lamps = page.evaluate("(() => { const v = reflfield.viewer(); return"
                              " v.lampsFor(v.cameraFor(90, 62), []).length; })()")  # fmt: skip
        assert lamps == 3

    @pytest.mark.parametrize("name", ["studio", "sky"])
    def test_surroundings_are_few_lights_of_known_sum(self, page, name, rounding):
        tolerance = rounding(np.float64, operations=64, scale=4)
        page.locator(f"input[name=map][value={name}]").check(force=True)
        page.locator("#map-rotation").fill("90")
        page.locator("#map-strength").fill("1")
        now = scene(page)["map"]
        assert now["name"] == name
        assert now["rotation"] == pytest.approx(np.pi / 2)
        lights = page.evaluate("reflfield.viewer().mapLights")
        assert len(lights["still"]) == 64
        assert len(lights["moving"]) == 8
        for some in lights.values():
            total = np.sum([light["power"] for light in some], axis=0)
            assert total @ [0.2126, 0.7152, 0.0722] == pytest.approx(4.0, abs=tolerance)
            lengths = np.linalg.norm([light["at"] for light in some], axis=1)
            np.testing.assert_allclose(lengths, 1, rounding(np.float64))

    def test_picture(self, page):
        page.locator("#exposure").fill("1.5")
        assert page.locator("#exposure-value").text_content() == "+1.5"
        for name, value in (("curve", "plain"), ("backdrop", "light"), ("show", "tangents")):
            page.locator(f"#{name}").select_option(value)
            assert scene(page)[name] == value
        assert "Tangents" in page.locator("#hint").text_content()
        for value in ("normals", "weights", "coverage", "picture"):
            page.locator("#show").select_option(value)
            settled(page)
        assert page.locator("#hint").is_hidden()

    def test_surface_against_hull(self, page, open_page):
        """Of a run that moved it: one side moved out is red, one moved in is blue."""
        assert page.locator("#show option[value=moved]").is_disabled()
        field = half_vector_field()
        moved = np.where(field.positions[:, 2] > field.positions[:, 2].mean(), 0.01, -0.02)
        html = object_page(field, "two spheres", moved=moved)
        opened = open_page(html, "show=moved&backdrop=dark", size=(300, 300))
        settled(opened)
        assert "Full colour:" in opened.locator("#hint").text_content()
        shown = np.array(Image.open(io.BytesIO(opened.screenshot())).convert("RGB"), int)
        red, blue = (shown[..., a] - shown[..., b] > 60 for a, b in ((0, 2), (2, 0)))
        assert min(red.sum(), blue.sum()) > 500
        assert np.nonzero(red)[0].mean() < np.nonzero(blue)[0].mean() - 20

    def test_photograph_beside_the_rendering(self, page):
        page.locator("#photo").select_option("0")
        settled(page)
        box = page.locator("#photograph").bounding_box()
        # Chromium lays out in 64ths of a pixel.
        assert box["width"] == pytest.approx(80 / 60 * box["height"], abs=2 / 64)
        assert page.locator("#hint").text_content() == "Held out."
        page.locator("#wipe").fill("25")
        settled(page)
        style = page.locator("#photograph-image").evaluate("e => e.style.clipPath")
        assert "75%" in style
        # The camera is the photograph's: the origin is drawn where it shows it.
        camera = page.evaluate("reflfield.viewer().cameraFor(900, 620)")
        assert camera["focal"] == pytest.approx([box["width"] / 2 / np.tan(np.radians(15))] * 2)
        assert camera["centre"] == pytest.approx(
            [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2]
        )
        drag(page, (200, 300), [(230, 320)])
        assert scene(page)["photo"] is None
        assert page.locator("#photograph").is_hidden()

    def test_buttons(self, page):
        page.locator("#turntable").click()
        before = scene(page)["camera"]["azimuth"]
        eventually(page, f"reflfield.viewer().scene.camera.azimuth > {before}")
        page.locator("#turntable").click()
        with page.expect_download() as download:
            page.locator("#save").click()
        assert download.value.suggested_filename == "two_spheres.png"
        picture = np.asarray(Image.open(download.value.path()).convert("RGB"), float)
        assert picture.std() > 5
        page.locator("#link").click()
        settled(page)
        assert page.url.partition("#")[2].startswith("view=")
        page.locator("#help").click()
        assert page.locator("#keys").is_visible()
        page.locator("#keys button").click()
        page.locator("#reset").click()
        assert scene(page)["camera"]["azimuth"] == 0
        page.locator("#full").click()
        eventually(page, "Boolean(document.fullscreenElement)")
        page.locator("#full").click()


def test_keys(page):
    page.locator("#picture").focus()
    changes = {
        "ArrowLeft": lambda s: s["camera"]["azimuth"],
        "ArrowUp": lambda s: s["camera"]["elevation"],
        "Shift+ArrowRight": lambda s: s["lamps"][0]["azimuth"],
        "+": lambda s: s["camera"]["distance"],
        "-": lambda s: s["camera"]["distance"],
        "2": lambda s: s["lamps"][1]["on"],
        "f": lambda s: s["flash"],
        "e": lambda s: s["map"]["name"],
        "v": lambda s: s["show"],
        "r": lambda s: s["flash"],
    }
    for key, value in changes.items():
        before = value(scene(page))
        page.keyboard.press(key)
        settled(page)
        assert value(scene(page)) != before, key
    page.keyboard.press("c")
    assert page.locator("#panel").is_hidden()
    page.keyboard.press("c")
    assert page.locator("#panel").is_visible()


def test_a_link_restores_the_view(page, open_page, html):
    page.locator("#lamp-3-on").check()
    page.locator("input[name=map][value=sky]").check(force=True)
    page.locator("#exposure").fill("-1")
    page.locator("#show").select_option("normals")
    drag(page, (200, 300), [(230, 320)])
    page.locator("#link").click()
    settled(page)
    wanted, fragment = scene(page), page.url.partition("#")[2]
    restored = scene(open_page(html, fragment))
    for name in ("azimuth", "elevation", "distance", "target"):
        # The link has five digits.
        assert restored["camera"][name] == pytest.approx(wanted["camera"][name], rel=5e-5)
    for name in ("flash", "exposure", "curve", "show", "backdrop", "photo", "map"):
        assert restored[name] == wanted[name]
    assert [lamp["on"] for lamp in restored["lamps"]] == [True, False, True]


@pytest.mark.parametrize(
    "fragment",
    ["view=1,2", "view=a,b,c,d,e,f", "view=1e999,0,0,0,0,0", "map=__proto__,0,0", "photo=7",
     "show=<img src=x>", "light1=,,,,", "%", "light1=0,0,1e9,1e9,zzzzzz"],
)  # fmt: skip
def test_links_that_make_no_sense_are_harmless(open_page, html, fragment):
    restored = scene(open_page(html, fragment))
    assert restored["show"] == "picture"
    assert restored["map"]["name"] == "none"
    assert restored["photo"] is None
    assert np.isfinite([restored["camera"]["distance"], restored["lamps"][0]["distance"]]).all()
    assert restored["lamps"][0]["distance"] <= 10


def test_on_a_phone_the_picture_comes_first(open_page, html):
    page = open_page(html, size=(390, 760))
    page.evaluate(NOT_REFINED)
    assert page.locator("#panel").is_hidden()
    button = page.locator("#panel-toggle")
    assert button.bounding_box()["height"] >= 44
    button.click()
    assert page.locator("#panel").is_visible()
    box = page.locator("#panel").bounding_box()
    assert box["width"] == 390
    assert box["height"] < 0.5 * 760
    free = page.evaluate("reflfield.viewer().free(innerWidth, innerHeight)")
    title = page.locator("header").bounding_box()
    assert free[1] == min(title["y"] + title["height"], 0.15 * box["y"])
    assert free[1] + free[3] == pytest.approx(box["y"])
    assert page.evaluate("document.documentElement.scrollWidth") == 390


class TestMaps:
    """Files of environment maps, dropped: read as the library reads them."""

    @pytest.fixture
    def radiance(self, rng):
        return rng.uniform(0.1, 2.0, (16, 32, 3)).astype(np.float32)

    def dropped(self, page, name, content):
        page.evaluate("document.querySelector('#message').hidden = true")
        page.locator("#map-file").set_input_files(
            {"name": name, "mimeType": "application/octet-stream", "buffer": content}
        )
        answered = (
            "reflfield.viewer().mapLights.still.length > 0"
            " || !document.querySelector('#message').hidden"
        )
        while not page.evaluate(answered):
            page.wait_for_timeout(20)
        return page.evaluate("reflfield.viewer().mapLights.still")

    def expected(self, radiance):
        """Sum of the lights times their directions, over their sum: independent of the cut."""
        lights = EnvironmentMap(radiance).quantise(64)
        return (lights.irradiances.sum(axis=1) @ lights.directions) / lights.irradiances.sum()

    def lights_shown(self, lights):
        power = np.array([light["power"] for light in lights]).sum(axis=1)
        return (power @ np.array([light["at"] for light in lights])) / power.sum()

    @pytest.mark.parametrize("compression", ["none", "zip", "zips"])
    def test_exr(self, page, radiance, tmp_path, compression, rounding):
        path = tmp_path / "map.exr"
        write_map(path, radiance, compression)
        lights = self.dropped(page, path.name, path.read_bytes())
        assert scene(page)["map"]["name"] == "file"
        tolerance = rounding(np.float64, operations=radiance[..., 0].size)
        shown = self.lights_shown(lights)
        np.testing.assert_allclose(shown, self.expected(radiance), rtol=0, atol=tolerance)

    @pytest.mark.parametrize("coded", [False, True])
    def test_hdr(self, page, radiance, coded, rounding):
        codes, kept = rgbe(radiance)
        rows = [hdr_row(row, coded) for row in codes]
        content = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16 +X 32\n" + b"".join(rows)
        lights = self.dropped(page, "map.hdr", content)
        tolerance = rounding(np.float64, operations=kept[..., 0].size)
        shown = self.lights_shown(lights)
        np.testing.assert_allclose(shown, self.expected(kept), rtol=0, atol=tolerance)

    def test_picture_is_srgb(self, page, rng, rounding):
        codes = rng.integers(40, 255, (16, 32, 3)).astype(np.uint8)
        stream = io.BytesIO()
        Image.fromarray(codes).save(stream, "PNG")
        lights = self.dropped(page, "map.png", stream.getvalue())
        share = codes / 255.0
        linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
        wanted = self.expected(linear.astype(np.float32))
        tolerance = rounding(np.float32)  # in which texels are kept
        np.testing.assert_allclose(self.lights_shown(lights), wanted, rtol=0, atol=tolerance)

    @pytest.mark.parametrize(
        ("name", "content", "why"),
        [("map.hdr", b"#?RADIANCE\n\n-Y 4 +X 8\n", "ends too early"),
         ("map.hdr", b"#?RADIANCE\n\n+Y 4 +X 8\n", "top left"),
         ("map.exr", b"\x76\x2f\x31\x01\x02\x02\x00\x00", "tiled"),
         ("map.tif", b"II*\x00", "What is read: Radiance HDR"),
         ("map.hdr", b"#?RADIANCE\n\n-Y 2 +X 2\n" + bytes(16), "twice as wide")],
    )  # fmt: skip
    def test_what_cannot_be_read_is_said(self, page, name, content, why):
        assert self.dropped(page, name, content) == []
        assert why in page.locator("#message").text_content()


def write_map(path, radiance, compression):
    """An EXR file of one compression, by the simulator's library."""
    import OpenEXR

    kinds = {"none": OpenEXR.NO_COMPRESSION, "zip": OpenEXR.ZIP_COMPRESSION,
             "zips": OpenEXR.ZIPS_COMPRESSION}  # fmt: skip
    header = {"compression": kinds[compression], "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": radiance}) as file:
        file.write(str(path))


def rgbe(radiance):
    """Codes of Radiance HDR and what they stand for."""
    exponent = np.ceil(np.log2(radiance.max(axis=2) + 1e-9)).astype(int)
    mantissa = np.floor(radiance / 2.0 ** exponent[..., None] * 256).clip(0, 255)
    codes = np.concatenate([mantissa, exponent[..., None] + 128], axis=2).astype(np.uint8)
    return codes, (mantissa * 2.0 ** (exponent[..., None] - 8)).astype(np.float32)


def hdr_row(row, coded):
    """One row, flat or in runs and literals."""
    if not coded:
        return row.tobytes()
    parts = [bytes([2, 2]) + struct.pack(">H", len(row))]
    for channel in row.T:
        parts.append(bytes([10]) + channel[:10].tobytes())
        for value in channel[10:]:
            parts.append(bytes([129, value]))
    return b"".join(parts)


class TestErrors:
    """Sentences instead of an empty page."""

    def damaged(self, html, number, change):
        pattern = rf'(id="block-{number}">)(.*?)(</script>)'
        return re.sub(pattern, lambda m: m[1] + change(m[2]) + m[3], html, flags=re.DOTALL)

    @pytest.mark.parametrize("number", [0, 1])
    @pytest.mark.parametrize(
        "change",
        [lambda text: text[: len(text) // 2 // 4 * 4], lambda text: "A" + text[1:],
         lambda text: "!" + text[1:],
         lambda text: base64.b64encode(zlib.compress(b"short")).decode()],
        ids=["cut", "changed", "no base64", "too short"],
    )  # fmt: skip
    def test_damaged_data(self, open_page, html, number, change):
        page = open_page(self.damaged(html, number, change), waits=False, errors_matter=False)
        page.locator("#message").wait_for(state="visible")
        assert "damaged" in page.locator("#message").text_content()
        assert page.evaluate("reflfield.error").startswith("The data in this file are")

    @pytest.mark.parametrize(
        ("missing", "words"),
        [("HTMLCanvasElement.prototype.getContext = () => null", "needs WebGL 2"),
         ("WebGL2RenderingContext.prototype.getExtension = () => null", "floating-point"),
         ("delete window.DecompressionStream", "cannot unpack")],
    )  # fmt: skip
    def test_browsers_that_cannot(self, browser, html, tmp_path, missing, words):
        (tmp_path / "object.html").write_text(html, encoding="utf-8")
        page = browser.new_page(viewport={"width": 64, "height": 64})
        page.add_init_script(missing)
        page.goto((tmp_path / "object.html").as_uri())
        page.locator("#message").wait_for(state="visible")
        assert words in page.locator("#message").text_content()
        page.close()

    def test_a_lost_graphics_card_comes_back(self, open_page, html):
        page = open_page(html)
        before = page.evaluate("reflfield.viewer().frames.moving")
        page.evaluate(
            "() => { const gl = reflfield.viewer().painter.gl;"
            " window.loss = gl.getExtension('WEBGL_lose_context'); loss.loseContext(); }"
        )
        page.locator("#message").wait_for(state="visible")
        assert "graphics card" in page.locator("#message").text_content()
        page.evaluate("loss.restoreContext()")
        page.locator("#message").wait_for(state="hidden")
        settled(page)
        assert page.evaluate("reflfield.viewer().frames.moving") > before
        # What is drawn again is the object, not an empty picture.
        lit = page.evaluate(
            "(() => { const v = reflfield.viewer(), c = v.cameraFor(32, 32); return Math.max("
            "...v.painter.numbers(c, v.lampsFor(c, []), { rays: [[0.5, 0.5]] })); })()"
        )
        assert lit > 0.01


def test_one_unknown_light_offers_no_lights(open_page):
    page = open_page(object_page(planar_field("unknown")), size=WINDOW)
    page.evaluate(NOT_REFINED)
    assert page.locator("#lights").is_hidden()
    assert page.locator("#surroundings").is_hidden()
    assert page.locator(".lamp-handle").first.is_hidden()
    assert "photographed in" in page.locator("#subtitle").text_content()
