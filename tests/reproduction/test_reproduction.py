"""The reproduction of the paper's tables and figures: parts, page, and what they show."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from reflfield.cli import main
from reflfield.errors import InputError
from reflfield.report.page import Note, Section
from reflfield.reproduction import correlation_tables, reproduce, texture_figures
from reflfield.reproduction.measured_felt import (
    DIRECTIONS,
    N_DIRECTIONS,
    REFLECTANCE,
    Felt,
    read_felt,
)
from reflfield.reproduction.object_figures import evening_sky, figure_10, scene_text
from reflfield.reproduction.paper_scene import (
    RINGS_151,
    dome_directions,
    frame_errors,
    relief_frames,
)
from reflfield.reproduction.synthetic_figures import (
    REFINED,
    SEARCHED,
    UNALIGNED,
    Recovered,
    energy_left,
    equal_components,
    figure_4,
    figure_5,
    figure_6,
    singular_values,
)

SIZE = 10, 8


@pytest.fixture
def counted(monkeypatch):
    """Parts that count how often they are computed, in place of the true ones."""
    calls = []

    def work(wanted, folder):
        calls.append(wanted.photograph_side)
        return [Section("Figure 0", "Nothing.", (Note("A note."),))]

    part = reproduce.Part(
        "figures9-10", work, "reflfield.reproduction.reproduce", ("photograph_side",)
    )
    monkeypatch.setattr(reproduce, "PARTS", (part,))
    return calls


def test_a_finished_part_is_not_made_again_and_an_option_of_it_makes_it_again(
    counted, tmp_path
):
    wanted = reproduce.Reproduction()
    page = reproduce.reproduce(tmp_path, wanted)
    first = page.read_text()
    assert "Figure 0" in first
    assert "reflfield --only figures9-10" in first
    reproduce.reproduce(tmp_path, replace(wanted, workers=2))
    assert counted == [96]
    assert page.read_text() == first
    reproduce.reproduce(tmp_path, replace(wanted, photograph_side=64))
    assert counted == [96, 64]


@pytest.mark.parametrize("content", ["", "{}", "[1]", '{"key": 1}', "\x00"])
def test_a_part_that_is_no_part_is_made_again(content, counted, tmp_path):
    reproduce.reproduce(tmp_path, reproduce.Reproduction())
    (tmp_path / "parts" / "figures9-10.json").write_text(content)
    reproduce.reproduce(tmp_path, reproduce.Reproduction())
    assert len(counted) == 2


def test_what_cannot_be_used_is_refused(tmp_path):
    with pytest.raises(InputError, match="only: expected parts of table1"):
        reproduce.reproduce(tmp_path, reproduce.Reproduction(), ["table3"])
    with pytest.raises(InputError, match="n_directions: expected 8 to 151, received 152"):
        reproduce.Reproduction(n_directions=152)
    with pytest.raises(InputError, match=r"xyz_loc.bin: expected the felt's file"):
        reproduce.reproduce(tmp_path, reproduce.Reproduction(felt=tmp_path))
    assert not list(tmp_path.iterdir())


def test_the_command_names_what_is_not_the_default(tmp_path):
    wanted = reproduce.Reproduction(photograph_side=64, workers=2)
    line = reproduce.command_of(tmp_path / "a b", wanted)
    assert line == f"reflfield reproduce -o '{tmp_path}/a b' --pixels 64"


def test_sections_come_back_from_json():
    some = perfect()
    for section in (figure_4(some), figure_5(some), figure_6(some)):
        content = json.loads(json.dumps(reproduce.to_json(section)))
        assert reproduce.from_json(content) == section


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--only", "table3"), "--only: expected parts of table1"),
        (("--directions", "152"), "--directions: expected 8 to 151, received 152"),
        (("--pixels", "1"), "--pixels: expected 32 to 512, received 1"),
        (("--felt", "nowhere"), "nowhere/xyz_loc.bin: expected the felt's file, found none"),
    ],
)
def test_the_command_refuses_with_status_2_and_leaves_nothing(
    words, message, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"
    monkeypatch.setattr("sys.argv", ["reflfield", "reproduce", "-o", str(out), *words])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert message in capsys.readouterr().err
    assert not out.exists()


# --- figures 4 to 8 ----------------------------------------------------------------------


def perfect():
    """The scene with its true frames as recovered ones."""
    truth = relief_frames(*SIZE)
    upright = np.tile(np.eye(3), (len(truth), 1, 1))
    frames = {UNALIGNED: upright, SEARCHED: truth, REFINED: truth}
    return Recovered(SIZE[::-1], truth, frames)


def test_true_frames_leave_one_component_and_no_error(rounding):
    table = figure_5(perfect()).items[1]
    by_name = {row[0]: row[1:] for row in table.rows}
    assert by_name["the paper's"][1] == 20
    # One column a hundred times over: nothing but rounding of float32 is left.
    assert by_name[REFINED][0] < 1e-9
    assert by_name[REFINED][1] > 20
    errors = {row[0]: row[1:] for row in figure_6(perfect()).items[1].rows}
    # The arc cosine of numbers near 1 keeps half the digits.
    assert max(errors[REFINED]) < np.degrees(np.sqrt(rounding(float)))


def test_components_are_counted_by_the_energy_that_they_leave(rounding):
    unaligned, aligned = np.array([4.0, 3.0, 2.0, 1.0]), np.array([5.0, 2.0, 1.0, 0.0])
    # 30 and 30 in all; aligned leaves 1/30 after two, unaligned 5, then 1.
    np.testing.assert_allclose(energy_left(unaligned)[1:3], [5 / 30, 1 / 30])
    assert equal_components(unaligned, aligned) == 3
    matrix = np.random.default_rng(1).standard_normal((6, 30))
    expected = np.linalg.svd(matrix, compute_uv=False)
    # Roots of the eigenvalues of a product of 30 columns.
    condition = (expected[0] / expected[-1]) ** 2
    tolerance = rounding(float, operations=30, condition=condition)
    np.testing.assert_allclose(singular_values(matrix), expected, rtol=tolerance)


def test_alignment_with_true_frames_keeps_the_picture_that_compression_alone_loses(rounding):
    texture = texture_figures.simulated_texture(*SIZE)
    assert texture.samples.shape == (80, 151, 151)
    frames = {UNALIGNED: np.tile(np.eye(3), (80, 1, 1)), REFINED: texture.truth}
    table = texture_figures.figure_8(texture, frames).items[1]
    errors = {row[0]: row[1:] for row in table.rows}
    singles = rounding(np.float32)  # as few components as the picture has
    assert errors[REFINED][0] < singles
    assert errors[UNALIGNED][0] > 0.1
    # What is left of the picture is the interpolation between 13 x 13 nodes.
    assert errors[REFINED][1] < 0.5 * errors[UNALIGNED][1]
    curves = texture_figures.figure_7(texture, frames).items[1].rows
    assert curves[1][1] < singles < 1e-3 < curves[0][1]


def test_maxima_on_the_papers_grid_lie_beside_the_frames(monkeypatch):
    texture = texture_figures.simulated_texture(6, 5)
    exact = SimpleNamespace(local_from_base=texture.truth)
    monkeypatch.setattr(texture_figures, "align", lambda *_, **__: exact)
    frames = texture_figures.frames_by_method(texture, 1)
    for name in (texture_figures.BRUTE, texture_figures.FACTORED):
        normals = frame_errors(frames[name], texture.truth)[0]
        # The grid's polar angles are 11 degrees apart and its azimuths 22: tilts of up to 31
        # degrees lie within half of either of a node, and the series of degree 7 adds some.
        assert normals.max() < 11.25
        assert np.median(normals) < 8.0


# --- tables ------------------------------------------------------------------------------


def test_tables_have_a_row_of_every_form_with_the_papers_figures(monkeypatch):
    monkeypatch.setattr(correlation_tables, "BAND_LIMITS", (4,))
    monkeypatch.setattr(correlation_tables, "ENOUGH_RUNS", 1)
    monkeypatch.setitem(correlation_tables.MANY, 4, 2)
    monkeypatch.setitem(correlation_tables.SHARE, 4, 64)
    for section, paper in (
        (correlation_tables.table_1(), correlation_tables.PAPER_1),
        (correlation_tables.table_2(), correlation_tables.PAPER_2),
    ):
        rows = {row[0]: row[1:] for row in section.items[0].rows}
        assert {name: rows[name][0] for name in paper} == {n: p[0] for n, p in paper.items()}
        assert all(row[1] > 0 for row in rows.values())
        assert len(rows) > len(paper)


# --- felt and object ---------------------------------------------------------------------


def write_felt(folder, reflectance):
    d = dome_directions(RINGS_151)
    np.concatenate([d.T, np.zeros((1, N_DIRECTIONS))]).tofile(folder / DIRECTIONS)
    logs = np.log(reflectance * d[:, 2]) / 3
    np.stack([logs, np.zeros_like(logs)]).tofile(folder / REFLECTANCE)
    return d


def test_a_felt_is_read_and_is_exact_at_the_measured_directions(tmp_path, rounding):
    d = dome_directions(RINGS_151)
    reflectance = 0.2 + 0.1 * np.exp(d @ [0.3, 0.1, 0.5])[:, None] * np.exp(d[:, 0])
    write_felt(tmp_path, reflectance)
    directions, values = read_felt(tmp_path)
    # A third of a logarithm, of size 1 or so, and the cube of its power.
    np.testing.assert_allclose(values, reflectance, rtol=rounding(float, operations=3))
    felt = Felt(directions, values)
    at = felt.samples(directions[None, :7], directions[None, 20:30])[0]
    # Splines through the data, stored in float32.
    np.testing.assert_allclose(at, reflectance[:7, 20:30] * d[20:30, 2], rtol=1e-5)
    below = np.array([[[0.6, 0.0, -0.8]]])
    assert not felt.samples(directions[None, :2], below).any()


def test_broken_felts_are_refused(tmp_path):
    write_felt(tmp_path, np.full((N_DIRECTIONS, N_DIRECTIONS), 0.3))
    (tmp_path / REFLECTANCE).write_bytes(b"12345678")
    with pytest.raises(InputError, match=f"{REFLECTANCE}: expected 364816 bytes"):
        read_felt(tmp_path)
    np.full(2 * N_DIRECTIONS**2, np.nan).tofile(tmp_path / REFLECTANCE)
    with pytest.raises(InputError, match="expected unit directions and finite logarithms"):
        read_felt(tmp_path)


def test_the_sky_lights_from_one_side_and_the_object_is_seen_from_three():
    import reflfield as rf

    sky = evening_sky()
    assert sky.min() > 0
    row, column, _ = np.unravel_index(sky.argmax(), sky.shape)
    assert row < len(sky) / 2
    figure = figure_10(rf.example_field()).items[0]
    assert len(figure.panels) == 3
    assert column < sky.shape[1] / 2


@pytest.mark.parametrize("directions", [32, 81, 151])
def test_scenes_of_the_simulator_have_so_many_cameras_and_lamps(directions, tmp_path):
    from capture_sim.scene import load_scene

    path = tmp_path / "scene.toml"
    path.write_text(scene_text(directions, 32))
    scene = load_scene(str(path))
    assert len(scene.cameras) == len(scene.lights) == directions


@pytest.mark.slow
def test_an_object_is_simulated_processed_and_shown(tmp_path):
    wanted = reproduce.Reproduction(n_directions=12, photograph_side=48)
    page = reproduce.reproduce(tmp_path, wanted, ["figures9-10"])
    text = page.read_text()
    assert "Figure 9: the vase" in text
    assert "Figure 10: image-based lighting" in text
