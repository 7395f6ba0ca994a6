"""Which photographs are held out: of dense captures, and of one light for each photograph."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reflfield.capture.cameras import Camera
from reflfield.capture.capture import Capture
from reflfield.capture.lights import Light
from reflfield.capture.photographs import Exposure, Photograph
from reflfield.errors import InputError
from reflfield.options import HoldOut, parse_hold_out
from reflfield.pipeline.hold_out import (
    farthest_first,
    held_out_sentence,
    left_out_sentences,
    split_of,
    spread_photographs,
    with_fewer_lights,
)


def capture_of(pairs, n_views, n_lights, silhouettes=()):
    """A capture with a photograph for each of some pairs of view and light; no files."""
    lens = {
        "kind": "opencv",
        "width": 8,
        "height": 8,
        "fl_x": 8.0,
        "fl_y": 8.0,
        "cx": 4.0,
        "cy": 4.0,
    }
    cameras = tuple(
        Camera(id=f"v{i}", camera_from_world=np.eye(4), **lens) for i in range(n_views)
    )
    lights = tuple(
        Light(f"l{j}", "directional", direction=np.array([0.0, 0.0, 1.0]))
        for j in range(n_lights)
    )
    photographs = tuple(
        Photograph(f"v{i}_l{j}", i, j, (Exposure(Path("none.exr")),)) for i, j in pairs
    )
    return Capture("rig", Path(), cameras, lights, photographs, silhouettes=silhouettes)


def dense(n_views, n_lights):
    pairs = [(i, j) for i in range(n_views) for j in range(n_lights)]
    return capture_of(pairs, n_views, n_lights)


def flash(n):
    """Each view has a light of its own: hand-held, or a flash on the camera."""
    return capture_of([(i, (7 * i) % n) for i in range(n)], n, n)


def pairs_of(capture, indices):
    return [(capture.photographs[i].camera, capture.photographs[i].light) for i in indices]


class TestDense:
    def test_views_and_lights_are_compared_where_both_are_held_out(self):
        capture = dense(14, 12)
        split = split_of(capture, HoldOut(views=2, lights=2))
        assert pairs_of(capture, split.compared) == [(3, 3), (3, 9), (10, 3), (10, 9)]
        assert (len(split.trained), len(split.aside), split.kind) == (120, 44, "both")
        assert held_out_sentence(split) == (
            "4 photographs of 2 held-out views under 2 held-out lights are compared; "
            "44 others of those are used for neither; 120 of 168 make the field"
        )

    def test_views_alone_are_compared_under_all_lights(self):
        capture = dense(14, 12)
        split = split_of(capture, HoldOut(views=2))
        assert {view for view, _ in pairs_of(capture, split.compared)} == {3, 10}
        assert (len(split.compared), len(split.trained), len(split.aside)) == (24, 144, 0)
        assert split.training_views.tolist() == [0, 1, 2, 4, 5, 6, 7, 8, 9, 11, 12, 13]

    def test_photographs_alone_leave_every_view_and_light(self):
        capture = dense(14, 12)
        split = split_of(capture, HoldOut(photographs=4))
        compared = pairs_of(capture, split.compared)
        # Steps of 14 / 4 views and of .618 of 12 lights: all views and lights differ.
        assert compared == [(1, 3), (5, 11), (8, 6), (12, 1)]
        assert (len(split.trained), len(split.aside)) == (164, 0)
        assert split.training(capture).n_views == 14
        assert split.training(capture).n_lights == 12
        assert [p.name for p in split.compared_capture(capture).photographs] == [
            f"v{i}_l{j}" for i, j in compared
        ]

    def test_many_are_thinned_and_counted(self):
        split = split_of(dense(20, 20), HoldOut(views=10))
        assert (len(split.compared), len(split.aside), len(split.trained)) == (64, 136, 200)
        everything = split_of(dense(20, 20), HoldOut(photographs=100))
        assert (len(everything.compared), len(everything.trained)) == (100, 300)

    @pytest.mark.parametrize(
        ("n_views", "n_lights", "count"), [(1, 40, 5), (40, 1, 5), (9, 4, 12)]
    )
    def test_photographs_are_spread_evenly_along_the_longer_axis(
        self, n_views, n_lights, count
    ):
        capture = dense(n_views, n_lights)
        split = split_of(capture, HoldOut(photographs=count))
        chosen = np.array(pairs_of(capture, split.compared))
        per_view = np.bincount(chosen[:, 0], minlength=n_views)
        per_light = np.bincount(chosen[:, 1], minlength=n_lights)
        longer = per_view if n_views > n_lights else per_light
        assert longer.max() - longer.min() <= 1
        assert len({tuple(pair) for pair in chosen}) == count


class TestOneLightForEachView:
    def test_views_alone_are_compared(self):
        capture = flash(40)
        split = split_of(capture, HoldOut(views=2))
        assert [view for view, _ in pairs_of(capture, split.compared)] == [10, 30]
        assert (len(split.trained), len(split.aside)) == (38, 0)

    def test_views_and_lights_that_never_meet_are_compared_all_the_same(self):
        capture = flash(40)
        split = split_of(capture, HoldOut(views=2, lights=2))
        assert [view for view, _ in pairs_of(capture, split.compared)] == [10, 30]
        assert split.kind == "both"  # 7 * 10 = 30 and 7 * 30 = 10, modulo 40
        moved = capture_of([(i, (7 * i + 1) % 40) for i in range(40)], 40, 40)
        split = split_of(moved, HoldOut(views=2, lights=2))
        assert (len(split.compared), len(split.trained), len(split.aside)) == (4, 36, 0)
        assert split.kind == "either"
        assert "none of them of both" in held_out_sentence(split)
        assert split.training(moved).n_views == 36
        (words,) = left_out_sentences(moved, split)
        assert words.startswith("2 cameras of which all photographs are held out")

    def test_photographs(self):
        capture = flash(40)
        split = split_of(capture, HoldOut(photographs=4))
        assert [view for view, _ in pairs_of(capture, split.compared)] == [5, 15, 25, 35]
        assert (len(split.trained), split.training(capture).n_lights) == (36, 36)


class TestGaps:
    def test_a_view_without_a_photograph_is_not_the_one_held_out(self):
        pairs = [(i, j) for i in (0, 2, 3) for j in range(4)]
        capture = capture_of(pairs, 4, 4)
        split = split_of(capture, HoldOut(views=1))
        assert split.views.tolist() == [2]
        assert split.training_views.tolist() == [0, 3]
        assert list(left_out_sentences(capture, split)) == [
            "1 camera without a photograph and a silhouette, left out: 'v1'"
        ]

    def test_a_silhouette_still_carves(self):
        pairs = [(i, j) for i in (0, 2, 3) for j in (0, 2)]
        capture = capture_of(pairs, 4, 3, silhouettes=(Path("a.png"),) * 4)
        split = split_of(capture, HoldOut())
        assert split.training_views.tolist() == [0, 1, 2, 3]
        assert split.training_lights.tolist() == [0, 2]
        assert list(left_out_sentences(capture, split)) == [
            "1 camera without a photograph, of which only the silhouette is used: 'v1'",
            "1 light without a photograph, left out: 'l1'",
        ]
        assert held_out_sentence(split) == "no photograph is held out; 6 of 6 make the field"


class TestRefused:
    @pytest.mark.parametrize(
        ("hold_out", "message"),
        [
            (HoldOut(views=3), "fewer than the 3 views, received 3"),
            (HoldOut(lights=2), "fewer than the 2 lights, received 2"),
            (HoldOut(photographs=6), "fewer than the 6 photographs, received 6"),
            (HoldOut(test=True), "test split"),
        ],
    )
    def test_more_than_there_are(self, hold_out, message):
        with pytest.raises(InputError, match=message):
            split_of(dense(3, 2), hold_out)

    def test_all_held_out_together(self):
        capture = capture_of([(0, 1), (1, 1), (1, 0)], 2, 2)
        with pytest.raises(InputError, match="photographs left to make the field of"):
            split_of(capture, HoldOut(views=1, lights=1))

    def test_no_photograph(self):
        with pytest.raises(InputError, match="rig: expected photographs, received none"):
            split_of(capture_of([], 2, 2), HoldOut())

    @pytest.mark.parametrize(
        "values",
        [
            {"views": -1},
            {"photographs": 1.5},
            {"lights": True},
            {"views": "2"},
            {"light_cone": 91},
            {"light_cone": float("nan")},
            {"light_cone": "25"},
        ],
    )
    def test_counts_that_are_none(self, values):
        with pytest.raises(InputError, match=f"hold_out: {next(iter(values))}"):
            HoldOut(**values)

    @pytest.mark.parametrize(
        "text",
        [
            "views=1,photographs=2",
            "test,views=1",
            "photographs=2,test",
            "tests",
            "test=1",
            "lights=1,light-cone=20deg",
            "test,light-cone=20deg",
            "light-cone=wide",
            "light-cone=-3",
        ],
    )
    def test_ways_that_cannot_be_mixed(self, text):
        with pytest.raises(InputError, match="views=K,lights=K, or photographs=K, or test"):
            parse_hold_out(text)


def test_the_text_says_what_it_was_read_from():
    for text in ("views=2,lights=3", "photographs=4", "test", "views=1,light-cone=25deg", ""):
        assert str(parse_hold_out(text)) == text


def test_photographs_are_spread_whatever_order_they_come_in(rng):
    views, lights = (a.ravel() for a in np.mgrid[:6, :5])
    chosen = np.flatnonzero(spread_photographs(views, lights, 4))
    order = rng.permutation(30)
    again = order[spread_photographs(views[order], lights[order], 4)]
    assert sorted(again) == chosen.tolist()


class TestLightCone:
    """Eight directional lights around the zenith, 12 degrees apart on one great circle."""

    @pytest.fixture
    def fan(self):
        capture = dense(3, 8)
        angles = np.deg2rad(12.0 * np.arange(8) - 42.0)
        lights = tuple(
            Light(f"l{j}", "directional", direction=np.array([np.sin(a), 0.0, np.cos(a)]))
            for j, a in enumerate(angles)
        )
        return replace(capture, lights=lights)

    def test_lights_near_the_middle_one_are_held_out_together(self, fan):
        split = split_of(fan, HoldOut(views=1, light_cone=25.0))
        assert split.lights.tolist() == [2, 3, 4, 5, 6]
        assert pairs_of(fan, split.compared) == [(1, j) for j in (2, 3, 4, 5, 6)]
        assert {j for _, j in pairs_of(fan, split.trained)} == {0, 1, 7}

    def test_without_views_all_are_compared(self, fan):
        split = split_of(fan, HoldOut(light_cone=13.0))
        assert split.lights.tolist() == [3, 4, 5]
        assert len(split.compared) == 9

    def test_a_cone_of_all_lights_is_refused(self, fan):
        with pytest.raises(InputError, match="60 degrees hold the 8 lights"):
            split_of(fan, HoldOut(light_cone=60.0))

    def test_lights_of_unknown_direction_are_refused(self, fan):
        lights = (*fan.lights[:7], Light("sky", "unknown"))
        with pytest.raises(InputError, match=r"light-cone: .*'sky'"):
            split_of(replace(fan, lights=lights), HoldOut(light_cone=25.0))


class TestDenseDomes:
    """A dome of 40 views and 90 lights, of which a part is enough."""

    @pytest.fixture
    def dome(self, rng):
        capture = dense(40, 90)
        towards = rng.normal(size=(90, 3)) + np.array([0.0, 0.0, 1.0])
        lights = tuple(
            Light(f"l{j}", "directional", direction=d) for j, d in enumerate(towards)
        )
        return replace(capture, lights=lights)

    @pytest.mark.parametrize(("most", "left"), [(2000, 53), (100, 32)])
    def test_every_view_keeps_the_same_lights(self, dome, most, left):
        whole = split_of(dome, HoldOut(views=2, lights=2))
        split = with_fewer_lights(whole, dome, most)
        assert len(split.training_lights) == left
        assert len(split.trained) == 38 * left
        assert np.unique(pairs_of(dome, split.trained), axis=0).shape == (38 * left, 2)
        both = np.concatenate([split.trained, split.redundant])
        np.testing.assert_array_equal(np.sort(both), whole.trained)
        np.testing.assert_array_equal(split.compared, whole.compared)
        training = split.training(dome)
        assert (training.n_views, training.n_lights) == (38, left)
        assert f"{38 * left} of 3600 make the field, those under {left} of the lights" in (
            held_out_sentence(split)
        )

    @pytest.mark.parametrize(
        ("capture", "most"),
        [
            pytest.param(dense(20, 20), 100, id="few lights"),
            pytest.param(dense(40, 90), 3600, id="few photographs"),
            pytest.param(dense(40, 90), 0, id="all asked for"),
            pytest.param(flash(200), 100, id="a light for each photograph"),
        ],
    )
    def test_nothing_is_left_out_of_others(self, capture, most):
        whole = split_of(capture, HoldOut())
        assert with_fewer_lights(whole, capture, most) is whole

    def test_lights_are_spread_over_their_directions(self, rng):
        # Nine of ten within ten degrees, the others far apart.
        near, far = np.array([0.0, 0, 1]) + 0.05 * rng.normal(size=(90, 3)), np.eye(3)
        directions = np.concatenate([near, far, -far])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        chosen = farthest_first(directions, 7)
        assert set(range(90, 96)) - {92} <= set(chosen.tolist())
        assert farthest_first(directions, 96).tolist() == list(range(96))
