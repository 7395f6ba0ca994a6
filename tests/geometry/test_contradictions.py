"""Silhouettes that contradict each other: who is named, why, and what becomes of the hull."""

from dataclasses import replace

import numpy as np
import pytest
import rigs

from reflfield.errors import GeometryError
from reflfield.geometry.visual_hull import HullOptions, visual_hull

COARSE = HullOptions(resolution=48, smoothing=5, n_triangles=0)
PROPER = replace(COARSE, tolerance=0)
WRONG = 5
AXES = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def rig():
    """Twelve cameras, and the silhouettes of an object without symmetry."""
    views = rigs.cameras(12, size=64, zoom=1.4)
    return views, [rigs.lobed_silhouette(view) for view in views]


@pytest.fixture(scope="module")
def volume(rig):
    """Volume of the hull of all views but the wrong one."""
    views, silhouettes = ([*items[:WRONG], *items[WRONG + 1 :]] for items in rig)
    return visual_hull(views, silhouettes, COARSE)[0].volume


def with_mask(rig, mask):
    views, silhouettes = rig
    return views, [mask if i == WRONG else s for i, s in enumerate(silhouettes)]


def with_camera(rig, **changes):
    views, silhouettes = rig
    moved = replace(views[WRONG], **changes)
    return [moved if i == WRONG else view for i, view in enumerate(views)], silhouettes


def shifted(mask, columns):
    return np.roll(mask, columns, axis=1)


def scaled(mask, factor):
    place = (np.arange(64) + 0.5 - 32.0) / factor + 32.0
    index = np.clip(place.astype(int), 0, 63)
    inside = (place >= 0.0) & (place < 64.0)
    return mask[np.ix_(index, index)] * (inside[:, None] & inside)


def rolled(pose, degrees):
    angle = np.radians(degrees)
    roll = np.eye(4)
    roll[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return roll @ pose


def test_views_that_agree_are_not_doubted(rig):
    mesh, report = visual_hull(*rig, COARSE)
    assert report.contradictions == report.left_out == report.warnings == ()
    assert report.missing.max() < 0.06  # blurred voxels of three quarters of a pixel
    assert mesh.volume > 0.9


@pytest.mark.parametrize(
    ("make", "kind", "words"),
    [
        (lambda mask: 1.0 - mask, "inverted", "it is inverted"),
        (lambda mask: shifted(mask, 8), "shifted", "shifted by 8 columns and 0 rows"),
        (lambda mask: shifted(mask, -5), "shifted", "shifted by -5 columns and 0 rows"),
        (lambda mask: mask[:, ::-1], "mirrored", "it is mirrored"),
        (lambda mask: mask[::-1], "upside down", "it is upside down"),
        (lambda mask: scaled(mask, 1.4), "scaled", "times as large as it should be"),
        (lambda mask: scaled(mask, 0.65), "scaled", "times as large as it should be"),
    ],
    ids=["inverted", "shifted", "shifted back", "mirrored", "upside down", "large", "small"],
)
def test_one_wrong_mask_is_named_explained_and_left_out(rig, volume, make, kind, words):
    mesh, report = visual_hull(*with_mask(rig, make(rig[1][WRONG])), COARSE)
    assert report.left_out == ("v005",)
    assert [c.view for c in report.contradictions] == ["v005"]
    why = report.contradictions[0].explanation
    assert why is not None
    assert why.kind == kind
    assert why.after > max(0.85, why.before + 0.15)
    assert "v005: its silhouette contradicts the 11 others" in report.warnings[0]
    assert words in report.warnings[0]
    assert mesh.volume == volume


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (lambda camera: {"camera_from_world": AXES @ camera.camera_from_world}, "camera axes"),
        (
            lambda camera: {
                "camera_from_world": np.linalg.solve(camera.camera_from_world, np.eye(4))
            },
            "inverse pose",
        ),
        (
            lambda camera: {
                "camera_from_world": AXES @ np.linalg.solve(camera.camera_from_world, np.eye(4))
            },
            "inverse pose and camera axes",
        ),
        (lambda camera: {"fl_x": 1.5 * camera.fl_x, "fl_y": 1.5 * camera.fl_y}, "scaled"),
        (lambda camera: {"camera_from_world": rolled(camera.camera_from_world, 90.0)}, None),
    ],
    ids=["OpenGL axes", "camera-to-world", "both", "focal length", "rolled by 90 degrees"],
)
def test_one_wrong_camera_is_named_and_left_out(rig, volume, change, kind):
    mesh, report = visual_hull(*with_camera(rig, **change(rig[0][WRONG])), COARSE)
    assert report.left_out == ("v005",)
    why = report.contradictions[0].explanation
    assert (why and why.kind) == kind
    assert mesh.volume == volume


def test_swapped_masks_are_both_named(rig):
    views, silhouettes = rig
    swapped = list(silhouettes)
    swapped[2], swapped[WRONG] = silhouettes[WRONG], silhouettes[2]
    _, report = visual_hull(views, swapped, COARSE)
    assert report.left_out == ("v002", "v005")
    assert "the silhouette of view 'v005' fits it" in report.warnings[0]
    assert "the silhouette of view 'v002' fits it" in report.warnings[1]


@pytest.mark.parametrize(("columns", "named"), [(1, False), (2, False), (4, True), (8, True)])
def test_shifts_are_noticed_from_a_tenth_of_the_object_on(rig, columns, named):
    # 35 pixels of object; what a voxel and a pixel explain is not held against a view.
    masks = with_mask(rig, shifted(rig[1][WRONG], columns))
    _, report = visual_hull(*masks, COARSE)
    assert report.left_out == (("v005",) if named else ())


def test_the_hull_proper_is_kept_on_request_and_the_remedy_is_named(rig, volume):
    masks = with_mask(rig, shifted(rig[1][WRONG], 8))
    mesh, report = visual_hull(*masks, PROPER)
    assert report.left_out == ()
    assert [c.view for c in report.contradictions] == ["v005"]
    assert 'set hull.tolerance = "auto"' in report.warnings[0]
    assert mesh.volume < 0.85 * volume


def test_a_hull_that_collapses_names_the_view_and_the_mistake(rig):
    match = r"v005: its silhouette contradicts the 11 others .* it is inverted"
    with pytest.raises(GeometryError, match=match):
        visual_hull(*with_mask(rig, 1.0 - rig[1][WRONG]), PROPER)


def test_masks_that_are_all_inverted_are_refused_as_such(rig):
    views, silhouettes = rig
    with pytest.raises(GeometryError, match="all are inverted"):
        visual_hull(views, [1.0 - silhouette for silhouette in silhouettes], COARSE)


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        (lambda m: AXES @ m, "camera axes are OpenGL's"),
        (lambda m: np.linalg.solve(m, np.eye(4)), "the poses are camera-to-world"),
        (
            lambda m: np.linalg.solve(AXES @ m, np.eye(4)),
            "camera-to-world read as world-to-camera, or the reverse, with the camera axes",
        ),
    ],
    ids=["OpenGL axes", "camera-to-world", "both"],
)
def test_another_convention_of_all_poses_is_refused_by_name(rig, pose, words):
    views, silhouettes = rig
    moved = [replace(v, camera_from_world=pose(v.camera_from_world)) for v in views]
    with pytest.raises(GeometryError, match=words):
        visual_hull(moved, silhouettes, COARSE)


def test_masks_of_many_objects_are_said_to_disagree(rig, rng):
    views, silhouettes = rig
    order = rng.permutation(len(views))
    try:
        _, report = visual_hull(views, [silhouettes[i] for i in order], COARSE)
    except GeometryError as error:
        said = str(error)
    else:
        said = " ".join(report.warnings)
    assert "silhouettes show parts that the others exclude" in said


# ---------------------------------------------------------------- honest variation


@pytest.mark.parametrize("n", [4, 8])
def test_few_views_are_not_doubted(n):
    views = rigs.cameras(n, size=48, zoom=1.4)
    _, report = visual_hull(views, [rigs.lobed_silhouette(view) for view in views], COARSE)
    assert report.warnings == ()


def test_noisy_outlines_and_views_cut_by_the_frame_are_not_doubted(rig, rng):
    views, silhouettes = rig
    noisy = [np.clip(s + rng.normal(0.0, 0.25, s.shape) * (s > 0) * (s < 1), 0, 1)
             for s in silhouettes]  # fmt: skip
    close = rigs.cameras(12, size=64, zoom=3.2)[3:5]
    noisy += [rigs.lobed_silhouette(camera) for camera in close]
    close = [replace(camera, id=f"close{i}") for i, camera in enumerate(close)]
    _, report = visual_hull([*views, *close], noisy, COARSE)
    assert report.leaves_image[-2:].all()
    assert report.warnings == ()


# ---------------------------------------------------------------- specks


def test_specks_at_the_border_are_named_and_removed(rig):
    views, silhouettes = rig
    dirty = [silhouette.copy() for silhouette in silhouettes]
    for mask in dirty[:3]:
        mask[0, 5] = mask[63, 40] = 1.0
    clean, _ = visual_hull(views, silhouettes, COARSE)
    mesh, report = visual_hull(views, dirty, COARSE)
    assert report.specks == {"v000": 2, "v001": 2, "v002": 2}
    assert "6 small parts of silhouettes that no other view supports" in report.warnings[0]
    assert not report.leaves_image.any()
    assert mesh.vertices.tobytes() == clean.vertices.tobytes()


def test_noise_that_leaves_no_hull_is_named(rig, rng):
    views, silhouettes = rig
    noisy = [np.where(rng.random(s.shape) < 0.15, 1.0 - s, s) for s in silhouettes]
    with pytest.raises(GeometryError) as caught:
        visual_hull(views, noisy, COARSE)
    assert "small parts beside the object" in caught.value.__notes__[0]
    assert "v000 " in caught.value.__notes__[0]


def test_small_parts_that_other_views_show_as_well_stay(rig):
    views, silhouettes = rig
    satellite = np.array([-0.75, -0.55, 0.1])
    shown = [
        np.maximum(s, rigs.ball_silhouette(view, satellite, 0.05))
        for view, s in zip(views, silhouettes, strict=True)
    ]
    mesh, report = visual_hull(views, shown, replace(COARSE, minimum_component=0.0, blur=0.3))
    assert report.specks == {}
    assert report.warnings == ()
    assert np.linalg.norm(mesh.vertices - satellite, axis=1).min() < 0.06


def test_few_views_do_not_outweigh_one_that_shows_more():
    """A part that three others lack removes nothing: the view is named and stays."""
    views = rigs.cameras(12, size=64, zoom=1.4)[:4]
    masks = [rigs.lobed_silhouette(view) for view in views]
    without, _ = visual_hull(views, masks, COARSE)
    masks[1] = masks[1].copy()
    masks[1][2:62, 44:62] = 1.0
    mesh, report = visual_hull(views, masks, COARSE)
    assert report.left_out == ()
    assert [one.view for one in report.contradictions] == ["v001"]
    assert report.warnings[0].endswith("the hull is made with it")
    # The part itself is carved away by the others, but where they cannot see behind it.
    assert mesh.volume >= without.volume * (1 - 1e-6)
