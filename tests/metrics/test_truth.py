"""Scores against truth: planted distances, angles, holes; files that lie."""

import json
import math
import os

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from reflfield.capture.readers import open_capture
from reflfield.errors import CaptureError, InputError, ShapeError
from reflfield.metrics.completion_error import completion_error
from reflfield.metrics.frame_errors import (
    SurfacePoints,
    angle_deg,
    frame_errors,
    surface_points,
    true_frames,
)
from reflfield.metrics.hull_distance import hull_distance
from reflfield.metrics.truth_files import TruthView, open_truth

DEGREES = math.degrees(1)  # errors of angles are printed in degrees


def sphere(radius, centre=(0, 0, 0), subdivisions=4):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return mesh.vertices + np.asarray(centre), mesh.faces


# --- hull -------------------------------------------------------------------------


def test_concentric_spheres_are_their_radii_apart():
    summary = hull_distance(sphere(0.11), sphere(0.10), voxel=0.002).summary()
    # Facets lie .07 % of r below their sphere on average; of two spheres most of it cancels.
    assert summary["mean_mm"] == pytest.approx(10, abs=7e-4 * 110)
    # The same in voxels of 2 mm.
    assert summary["mean_voxels"] == pytest.approx(5, abs=7e-4 * 55)
    assert summary["outside_share"] == 1
    inner = hull_distance(sphere(0.09), sphere(0.10))
    assert inner.outside == 0
    assert inner.signed.mean() == pytest.approx(-0.01, abs=7e-4 * 0.1)  # facets


def test_half_of_a_shifted_sphere_is_outside():
    distance = hull_distance(sphere(1, centre=(0.02, 0, 0)), sphere(1))
    # Signed distance is the shift times the cosine: uniform in +-0.02, mean size 0.01.
    assert np.abs(distance.signed).mean() == pytest.approx(0.01, abs=4e-4)
    # Facets .0007 lower move the border by .0007 / .02 / 2; 3 sigma of 20,000 draws: .011.
    assert distance.outside == pytest.approx(0.5, abs=0.03)


@pytest.mark.reference
def test_distances_are_those_of_trimesh_far_from_the_origin(rng):
    truth = trimesh.creation.annulus(0.3, 0.5, 0.4)
    hull = trimesh.creation.cylinder(0.52, 0.44)
    away = np.array([40.0, -7.0, 13.0])
    distance = hull_distance(
        (hull.vertices + away, hull.faces), (truth.vertices + away, truth.faces), n_samples=500
    )
    expected = hull_distance(
        (hull.vertices, hull.faces), (truth.vertices, truth.faces), n_samples=500
    )
    assert np.allclose(distance.signed, expected.signed, atol=1e-6)  # float32 of a size 1 mesh
    # The cap over the bore is nearest to the bore's rim, by hand:
    # its middle lies hypot(0.3, 0.02) away (half heights 0.22 and 0.20).
    assert distance.signed.max() == pytest.approx(math.hypot(0.3, 0.02), rel=0.1)
    assert distance.outside == 1


def test_shares_of_either_side_are_those_of_the_areas():
    """A box around an ellipsoid's waist: sides told apart by the ellipsoid's equation."""
    axes = np.array([1.0, 0.5, 0.7])
    truth = trimesh.creation.icosphere(subdivisions=4)
    hull = trimesh.creation.box([1.6, 0.7, 1.0])
    distance = hull_distance((hull.vertices, hull.faces), (truth.vertices * axes, truth.faces))
    points, _ = trimesh.sample.sample_surface(hull, 20_000, seed=1)
    inside = ((points / axes) ** 2).sum(axis=1) < 1
    assert 0.1 < inside.mean() < 0.9
    # Binomial deviation of 20,000 free draws is 0.0035.
    assert 1 - distance.outside == pytest.approx(inside.mean(), abs=0.015)


def test_hull_without_faces_or_area_is_refused():
    nothing = np.zeros((0, 3))
    with pytest.raises(InputError, match="hull: expected a mesh with faces"):
        hull_distance((nothing, nothing), sphere(1))
    with pytest.raises(InputError, match="degenerate"):
        hull_distance((np.zeros((3, 3)), [[0, 1, 2]]), sphere(1))
    with pytest.raises(InputError, match="voxel"):
        hull_distance(sphere(1), sphere(1), voxel=0.0)


# --- frames -----------------------------------------------------------------------


@pytest.fixture
def surface(rng):
    """Random shading frames; every point its own material, so none is interpolated."""
    frames = Rotation.random(500, random_state=rng).as_matrix()
    position = rng.normal(size=(500, 3))
    position /= np.linalg.norm(position, axis=1, keepdims=True)
    points = SurfacePoints(position, frames[:, 2], frames[:, 0], np.arange(500))
    return points, frames


@pytest.mark.parametrize("degrees", [0.0, 1e-6, 3.0, 89.0])
def test_planted_tilts_and_turns_are_found(surface, degrees, rounding):
    points, frames = surface
    # Turning about the tangent (row 0) tilts the normal only, and the reverse.
    tilt, turn = (
        Rotation.from_rotvec(np.radians(degrees) * a).as_matrix() for a in np.eye(3)[[0, 2]]
    )
    tilted = frame_errors(true_frames(points.position, points, 1e-9), tilt @ frames)
    turned = frame_errors(true_frames(points.position, points, 1e-9), turn @ frames)
    tolerance = rounding(float, operations=9, scale=DEGREES)
    assert np.abs(tilted.normal - degrees).max() < tolerance
    assert tilted.tangent.max() < tolerance
    assert turned.normal.max() < tolerance
    assert np.abs(turned.tangent - degrees).max() < tolerance
    assert np.array_equal(turned.label, points.label)


def ball(count, rng):
    """Random points of the unit ball's surface: normals outward, tangents along parallels."""
    normal = rng.normal(size=(count, 3))
    normal[:, 2] *= 0.3  # away from the poles, where the tangents meet
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tangent = np.cross([0, 0, 1.0], normal)
    return normal, tangent / np.linalg.norm(tangent, axis=1, keepdims=True)


def test_frames_between_points_are_interpolated_to_second_order(rng):
    normal, tangent = ball(300, rng)
    frames = np.stack([tangent, np.cross(normal, tangent), normal], axis=1)
    worst = []
    for count in (4_000, 16_000):
        at, along = ball(count, rng)
        along *= rng.choice([-1.0, 1.0], (count, 1))  # tangents are lines
        points = SurfacePoints(at, at, along, np.zeros(count, int))
        errors = frame_errors(true_frames(normal, points, 0.1), frames)
        worst.append(max(np.median(errors.normal), np.median(errors.tangent)))
    # Spacing 1 / 64 rad at 16,000 points: the nearest point alone is 0.4 degrees off.
    assert worst[1] < 0.02
    # Four times the points, half the spacing: a quarter of the error, up to scatter.
    assert worst[0] / worst[1] == pytest.approx(4, rel=0.35)


def test_materials_are_not_mixed(rng):
    """Two materials that meet at x = 0 with tangents 90 degrees apart."""
    at = rng.uniform(-1, 1, (4_000, 3)) * [1, 1, 0]
    label = (at[:, 0] > 0).astype(int)
    points = SurfacePoints(at, np.tile([0, 0, 1.0], (4_000, 1)), np.eye(3)[label], label)
    expected = np.array([np.eye(3), np.eye(3)[[1, 0, 2]] * [[1], [-1], [1]]])[label]
    errors = frame_errors(true_frames(at, points, 0.01), expected)
    assert errors.tangent.max() == 0


def test_tangents_are_lines(surface, rounding):
    points, frames = surface
    half_turn = np.diag([-1.0, -1.0, 1.0])
    errors = frame_errors(true_frames(points.position, points, 1e-9), half_turn @ frames)
    assert errors.tangent.max() < rounding(float, scale=DEGREES)


def turned_about_normals(frames, degrees):
    """Frames turned about their own normals (rows 2)."""
    turn = Rotation.from_rotvec(np.radians(degrees)[:, None] * [0, 0, 1.0]).as_matrix()
    return np.swapaxes(turn, 1, 2) @ frames


def test_one_turn_is_removed_for_each_target_and_material(rng):
    n = 3000
    frames = Rotation.random(n, random_state=rng).as_matrix()
    position = rng.normal(size=(n, 3))
    # Material of each point; points of one material near each other must not be mixed.
    label, target = rng.integers(0, 2, n), rng.integers(0, 3, n)
    points = SurfacePoints(position, frames[:, 2], frames[:, 0], label)
    planted = np.array([[-80.0, 30.0], [0.0, 89.0], [45.0, -45.0]])
    noise = rng.normal(0, 4.0, n) + 180.0 * rng.integers(0, 2, n)
    recovered = turned_about_normals(frames, planted[target, label] + noise)
    errors = frame_errors(true_frames(position, points, 1e-9), recovered, target)
    assert {(t.target, t.label) for t in errors.rotations} == set(np.ndindex(3, 2))
    for turn in errors.rotations:
        # The mean of about 500 turns of 4 degrees: 0.18; five times that.
        apart = turn.degrees - planted[turn.target, turn.label]
        assert abs((apart + 90) % 180 - 90) < 0.9
        assert turn.n_texels == ((target == turn.target) & (label == turn.label)).sum()
    # Mean size of a normal error of 4 degrees, to its own scatter.
    assert errors.tangent.mean() == pytest.approx(4 * np.sqrt(2 / np.pi), rel=0.06)
    # Where no neighbour of the material lies near, the true frame is the point's own.
    assert np.median(errors.normal) < 1e-6
    # Without targets nothing is removed.
    assert frame_errors(true_frames(position, points, 1e-9), recovered).tangent.mean() > 30


def test_tilt_does_not_bias_the_turn(rng):
    n = 4000
    frames = Rotation.random(n, random_state=rng).as_matrix()
    points = SurfacePoints(np.eye(3)[rng.integers(0, 3, n)] + rng.normal(size=(n, 3)),
                           frames[:, 2], frames[:, 0], np.zeros(n, int))  # fmt: skip
    tilt = rng.normal(0, np.radians(8.0), (n, 3)) * [1, 1, 0]
    tilted = Rotation.from_rotvec(tilt).as_matrix() @ turned_about_normals(
        frames, np.full(n, 20.0)
    )
    (turn,) = frame_errors(
        true_frames(points.position, points, 1e-9), tilted, np.zeros(n, int)
    ).rotations
    # A tilt of 8 degrees moves single tangents by up to half a degree about the normal.
    assert turn.degrees == pytest.approx(20.0, abs=0.05)


def test_random_tangents_stay_random(rng):
    n = 5000
    frames = Rotation.random(n, random_state=rng).as_matrix()
    position = rng.normal(size=(n, 3))
    points = SurfacePoints(position, frames[:, 2], frames[:, 0], np.zeros(n, int))
    recovered = turned_about_normals(frames, rng.uniform(0, 180, n))
    errors = frame_errors(true_frames(position, points, 1e-9), recovered, np.zeros(n, int))
    # Uniform from 0 to 90: mean 45, its scatter .37; the turn removed gains as much.
    assert errors.tangent.mean() == pytest.approx(45.0, abs=1.5)


def test_targets_of_other_texels_are_refused(surface):
    points, frames = surface
    with pytest.raises(ShapeError, match="targets"):
        frame_errors(true_frames(points.position, points, 1e-9), frames, np.zeros(3, int))


def test_world_frame_does_not_matter(surface, rng, rounding):
    points, frames = surface
    noisy = Rotation.from_rotvec(rng.normal(0, 0.1, (500, 3))).as_matrix() @ frames
    world = Rotation.random(random_state=rng).as_matrix()
    moved = SurfacePoints(
        *(v @ world.T for v in (points.position, points.normal, points.tangent)), points.label
    )
    before = frame_errors(true_frames(points.position, points, 1e-6), noisy)
    after = frame_errors(true_frames(points.position @ world.T, moved, 1e-6), noisy @ world.T)
    # Products of three matrices.
    products = rounding(float, operations=9, scale=DEGREES)
    np.testing.assert_allclose(after.normal, before.normal, rtol=0, atol=products)
    np.testing.assert_allclose(after.tangent, before.tangent, rtol=0, atol=products)


def test_far_texels_and_broken_frames_are_left_out(surface):
    points, frames = surface
    positions, broken = points.position.copy(), frames.copy()
    positions[3] *= 2
    broken[5] = np.nan
    errors = frame_errors(true_frames(positions, points, 0.01), broken)
    assert np.array_equal(errors.texel, np.setdiff1d(np.arange(500), [3, 5]))
    assert errors.summary()["n_texels"] == 498


@pytest.mark.stability
def test_nothing_to_match_is_defined():
    empty = surface_points([])
    errors = frame_errors(true_frames(np.zeros((2, 3)), empty, 1.0), np.stack([np.eye(3)] * 2))
    assert errors.summary()["n_texels"] == 0
    assert math.isnan(errors.summary()["normal_mean_deg"])


def test_pixels_that_miss_are_no_surface_points():
    view = small_view()
    points = surface_points([view, view])
    assert len(points.position) == 2 * 10
    assert len(surface_points([view] * 4, max_points=20).position) == 20
    assert (points.label >= 0).all()


@pytest.mark.stability
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 90.0, 179.9999, 180.0])
def test_angles_are_accurate_at_their_ends(angle, rounding):
    turned = [np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0]
    assert angle_deg([1e-3, 0, 0], turned) == pytest.approx(angle, rel=rounding(float), abs=0)


# --- completion -------------------------------------------------------------------


def test_completion_error_counts_only_its_own_entries(rng, rounding):
    true = rng.uniform(0.1, 1, (5, 6, 7, 3))
    observed = rng.uniform(size=(5, 6, 7)) < 0.6
    completed = np.where(observed[..., None], true * 1.01, true * 0.8)
    error = completion_error(completed, true, observed)
    # Of 1.01 less 1 a hundredth is left, of the others more.
    differences = rounding(float, operations=3, condition=100)
    assert error.unobserved == pytest.approx(0.2, rel=differences)
    assert error.observed == pytest.approx(0.01, rel=differences)
    assert error.unobserved_cube_root == pytest.approx(1 - 0.8 ** (1 / 3), rel=differences)
    assert error.n_unobserved == 3 * (~observed).sum()


@pytest.mark.stability
def test_completion_error_of_degenerate_input():
    error = completion_error(np.ones(3), np.ones(3), np.ones(3, bool))
    assert math.isnan(error.unobserved)
    assert completion_error([np.nan, 1], [np.nan, 1], [False, False]).n_unobserved == 1
    with pytest.raises(InputError, match="completed"):
        completion_error([np.nan, 1], [1, 1], [False, True])
    with pytest.raises(ShapeError, match="completed"):
        completion_error(np.ones((3, 2)), np.ones((3, 2)), np.ones(2, bool))


# --- files ------------------------------------------------------------------------


def small_view():
    label = np.full((4, 5), -1, np.int16)
    label[1:3] = 0
    unit = np.zeros((4, 5, 3), np.float32)
    unit[1:3, :, 2] = 1
    depth = np.where(label >= 0, 1, np.inf).astype(np.float32)
    return TruthView(depth, np.where(unit == 1, 1, np.nan_to_num(unit)), unit, unit, label)


@pytest.fixture
def capture(tmp_path):
    (tmp_path / "truth" / "views").mkdir(parents=True)
    (tmp_path / "truth" / "truth.json").write_text(
        json.dumps({"version": 1, "mesh": "truth/mesh.ply"})
    )
    vertices, faces = sphere(1, subdivisions=1)
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "truth" / "mesh.ply")
    np.savez(tmp_path / "truth" / "views" / "v000.npz", **vars(small_view()))
    return tmp_path


def test_truth_is_read_from_its_files(capture):
    truth = open_truth(capture)
    vertices, faces = truth.mesh()
    assert vertices.shape == (42, 3)
    assert faces.shape == (80, 3)
    assert np.array_equal(truth.view("v000").label, small_view().label)
    assert truth.has_view("v000")
    assert not truth.has_view("v001")
    assert truth.heldout() is None
    assert truth.samples() is None


def test_captures_without_truth_have_none(tmp_path):
    assert open_truth(tmp_path) is None


def test_truth_that_lies_is_refused(capture):
    truth = open_truth(capture)
    with pytest.raises(CaptureError, match="inside"):
        truth.view("../../../secret")
    with pytest.raises(CaptureError, match=r"v009\.npz"):
        truth.view("v009")
    (capture / "truth" / "truth.json").write_text('{"version": 2}')
    with pytest.raises(CaptureError, match="version 1, received 2"):
        open_truth(capture)
    (capture / "truth" / "truth.json").write_text("[1]")
    with pytest.raises(CaptureError, match="object, received list"):
        open_truth(capture)
    (capture / "truth" / "truth.json").write_text("{")
    with pytest.raises(CaptureError, match="JSON"):
        open_truth(capture)


VIEW = "v000.npz"


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda a: a.pop("normal"), r"v000\.npz.*without normal"),
        (lambda a: a.update(depth=np.zeros((4, 6))), r"position: expected .*\(4, 5, 3\)"),
        (lambda a: a.update(position=np.zeros((4, 5, 2))), r"position.*\(4, 5, 2\)"),
        (lambda a: a.update(label=np.array([["a"] * 5] * 4)), "label: expected numbers"),
        (lambda a: a.update(tangent=np.array([{}], dtype=object)), "pickled objects"),
    ],
)
def test_a_view_that_does_not_hold_together_is_refused(capture, spoil, words):
    arrays = dict(vars(small_view()))
    spoil(arrays)
    np.savez(capture / "truth" / "views" / VIEW, **arrays)
    with pytest.raises(CaptureError, match=words):
        open_truth(capture).view("v000")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda a: a["views"].fill(np.nan), "views: expected finite numbers"),
        (lambda a: a["position"].fill(np.inf), "position: expected finite numbers"),
        (lambda a: a.pop("samples"), "without samples"),
        (lambda a: a.update(lights=np.ones((7, 3, 3))), r"light_visible: .*\(7, 2\)"),
    ],
)
def test_samples_that_do_not_hold_together_are_refused(capture, spoil, words):
    shapes = {"position": (7, 3), "frame": (7, 3, 3), "views": (7, 4, 3), "lights": (7, 2, 3)}
    arrays = {name: np.ones(shape) for name, shape in shapes.items()}
    arrays |= {"light_visible": np.ones((7, 2), bool), "samples": np.ones((7, 4, 2, 3))}
    np.savez(capture / "truth" / "abrdf.npz", **arrays)
    # Samples that are not known may be NaN; they are left out of the score.
    assert open_truth(capture).samples()["samples"].shape == (7, 4, 2, 3)
    spoil(arrays)
    np.savez(capture / "truth" / "abrdf.npz", **arrays)
    with pytest.raises(CaptureError, match=words):
        open_truth(capture).samples()


def test_a_view_of_another_size_or_with_nan_is_refused(capture):
    truth = open_truth(capture)
    assert truth.view("v000", (5, 4)).depth.shape == (4, 5)
    with pytest.raises(CaptureError, match=r"v000\.npz: expected 6 x 4 .*received 5 x 4"):
        truth.view("v000", (6, 4))
    arrays = dict(vars(small_view()))
    arrays["normal"] = np.full_like(arrays["normal"], np.nan)
    np.savez(capture / "truth" / "views" / VIEW, **arrays)
    with pytest.raises(CaptureError, match=r"v000\.npz: normal: expected .* received NaN"):
        truth.view("v000")


def test_views_that_inflate_beyond_their_camera_are_not_unpacked(capture):
    arrays = {**vars(small_view()), "depth": np.zeros((3000, 3000))}
    np.savez_compressed(capture / "truth" / "views" / VIEW, **arrays)
    with pytest.raises(CaptureError, match=r"v000\.npz: expected arrays of at most"):
        open_truth(capture).view("v000", (5, 4))


@pytest.mark.parametrize("key", ["views", "abrdf", "mesh", "heldout"])
def test_what_is_no_file_or_no_path_is_said(capture, key):
    """A pipe is not taken for a file that is missing; a list for the default."""
    text = json.dumps({"version": 1, key: "truth/pipe"})
    (capture / "truth" / "truth.json").write_text(text)
    os.mkfifo(capture / "truth" / "pipe")
    truth = open_truth(capture)
    use = {
        "views": lambda: truth.has_view("v000") and truth.view("v000"),
        "abrdf": lambda: truth.samples(),
        "mesh": lambda: truth.mesh(),
        "heldout": lambda: open_capture(truth.heldout()),
    }[key]
    with pytest.raises(InputError, match=r"pipe: expected "):
        use()
    for value in (["a"], 3, None):
        (capture / "truth" / "truth.json").write_text(json.dumps({"version": 1, key: value}))
        truth = open_truth(capture)
        with pytest.raises(CaptureError, match=rf"truth\.json: {key}: expected a path"):
            use()
    for value in ("a\0b", "../x", "loop/a"):
        os.path.lexists(capture / "loop") or (capture / "loop").symlink_to("loop")
        (capture / "truth" / "truth.json").write_text(json.dumps({"version": 1, key: value}))
        truth = open_truth(capture)
        with pytest.raises(InputError, match=r"expected |cannot be read"):
            use()


def test_a_mesh_without_all_its_faces_is_refused(capture):
    mesh = trimesh.Trimesh(*sphere(1, subdivisions=1), process=False)
    text = mesh.export(file_type="ply", encoding="ascii").decode().splitlines()
    (capture / "truth" / "mesh.ply").write_text("\n".join(text[:-9]))
    with pytest.raises(CaptureError, match=r"mesh\.ply: expected a mesh"):
        open_truth(capture).mesh()


@pytest.mark.parametrize(
    "text",
    [
        b"ply\nformat ascii 1.0\nelement vertex 9\n",
        b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
        b"property float z\nelement face 1\nproperty list uchar int vertex_indices\n"
        b"end_header\n0 0 0\n1 0 0\n0 nan 0\n3 0 1 2\n",
        b"",
    ],
    ids=["cut off", "nan", "empty"],
)
def test_a_mesh_that_is_none_is_refused(capture, text):
    (capture / "truth" / "mesh.ply").write_bytes(text)
    with pytest.raises(CaptureError, match=r"mesh\.ply: expected a mesh"):
        open_truth(capture).mesh()
