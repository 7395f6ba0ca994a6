"""Fingers on the picture: one turns the view, two zoom and move it, a light follows one."""

import numpy as np
import pytest

from reflfield.viewer.object_page import object_page
from tests.viewer.shown_fields import half_vector_field
from tests.viewer.test_controls import NOT_REFINED

PHONE = (390, 760)


@pytest.fixture(scope="module")
def only_page(open_shared_page):
    """The page on a phone, at a small scale, so that the software renderer keeps up."""
    html = object_page(half_vector_field(), "two spheres")
    opened = open_shared_page(html, size=PHONE, touch=True)
    opened.evaluate("() => { reflfield.viewer().movingScale = 0.1; }")
    opened.evaluate(NOT_REFINED)
    return opened


@pytest.fixture
def page(only_page):
    """The page as it was when it was opened."""
    only_page.evaluate("reflfield.act.reset()")
    return only_page


@pytest.fixture
def touch(page):
    """Function that puts fingers down, moves them from place to place, and lifts them."""
    session = page.context.new_cdp_session(page)

    def send(kind, places):
        points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(places)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    def along(*steps):
        send("touchStart", steps[0])
        for places in steps[1:]:
            send("touchMove", places)
        send("touchEnd", [])
        while not page.evaluate("reflfield.viewer().isStill"):
            page.wait_for_timeout(20)
        return page.evaluate("reflfield.viewer().scene")

    return along


def test_one_finger_turns_the_view(page, touch, rounding):
    before = page.evaluate("reflfield.viewer().scene.camera")
    after = touch([(195, 300)], [(215, 310)], [(255, 340)])["camera"]
    tolerance = rounding(np.float64, scale=2 * np.pi)
    # 0.007 radians a pixel; the page must not scroll instead, which would end the drag.
    assert before["azimuth"] - after["azimuth"] == pytest.approx(0.007 * 60, abs=tolerance)
    assert after["elevation"] - before["elevation"] == pytest.approx(0.007 * 40, abs=tolerance)
    assert after["distance"] == before["distance"]
    assert page.evaluate("[scrollX, scrollY, visualViewport.scale]") == [0, 0, 1]


def test_two_fingers_zoom(page, touch):
    before = page.evaluate("reflfield.viewer().scene.camera")
    steps = [[(195 - d, 300), (195 + d, 300)] for d in (40, 45, 50, 55, 60)]
    after = touch(*steps)["camera"]
    # The object comes nearer as the fingers part; steps of less than a fifth are not clamped.
    assert before["distance"] / after["distance"] == pytest.approx(60 / 40, rel=1e-3)
    assert after["azimuth"] == before["azimuth"]
    # The fingers move one after the other, at distances that differ by a tenth: what is left of
    # their moves is a tenth of 2.5 pixels a step, of 1/100 of the object.
    assert after["target"] == pytest.approx(before["target"], abs=0.01)
    assert page.evaluate("visualViewport.scale") == 1


def test_two_fingers_move(page, touch, rounding):
    before = page.evaluate("reflfield.viewer().scene.camera")
    steps = [[(150 + d, 300), (230 + d, 300)] for d in (0, 5, 10, 15, 20)]
    after = touch(*steps)["camera"]
    moved = np.linalg.norm(np.subtract(after["target"], before["target"]))
    focal = page.evaluate("reflfield.viewer().cameraFor(innerWidth, innerHeight).focal")[0]
    # The fingers move one after the other, at distances that differ by up to a tenth.
    assert moved == pytest.approx(20 * before["distance"] / focal, rel=0.1)
    tolerance = rounding(np.float64, operations=10, scale=before["distance"])
    assert after["distance"] == pytest.approx(before["distance"], abs=tolerance)
    assert (after["azimuth"], after["elevation"]) == (before["azimuth"], before["elevation"])


def test_a_light_follows_a_finger(page, touch):
    dot = page.locator(".lamp-handle").first
    box = dot.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    before = page.evaluate("reflfield.viewer().scene")
    after = touch([(x, y)], [(x - 15, y + 20)], [(x - 30, y + 30)])
    moved = dot.bounding_box()
    assert moved["x"] + moved["width"] / 2 == pytest.approx(x - 30, abs=1)  # whole pixels
    assert moved["y"] + moved["height"] / 2 == pytest.approx(y + 30, abs=1)  # whole pixels
    assert after["lamps"][0] != before["lamps"][0]
    assert after["camera"] == before["camera"]
