"""The capture on disk: its bytes, its schema, and that nothing half-done stays."""

import filecmp
import json
import zipfile
from pathlib import Path

import jsonschema
import numpy as np
import OpenEXR
import pytest
from PIL import Image

import capture_sim.write
from capture_sim.errors import SceneError
from capture_sim.files import write_exr, write_npz, write_ply
from capture_sim.objects import make_object
from capture_sim.scene import parse_scene
from capture_sim.write import write_capture

SCHEMA = Path(__file__).parents[2] / "reflfield" / "capture" / "schema" / "capture-v1.json"


def scene(**changed):
    return parse_scene(
        {
            "name": "tiny",
            "object": {"preset": "vase", "around": 48, "along": 32},
            "material": {"preset": "painted_vase"},
            "cameras": {
                "preset": "rings",
                "elevations_deg": [20],
                "counts": [3],
                "target": [0, 0, 0.1],
                "width": 24,
                "height": 20,
            },
            "lights": {"preset": "fibonacci", "n": 3},
            "effects": {"sensor_noise": {"electrons_per_radiance": 1e4, "read_noise": 1.0}},
            "heldout": {"frames": 2},
            "truth": {"points": 20},
            **changed,
        }
    )


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_capture(scene(), tmp_path_factory.mktemp("captures") / "tiny")


def read_exr(path):
    with OpenEXR.File(str(path)) as file:
        return file.channels()["RGB"].pixels


def files_of(folder):
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


def test_all_files_are_there(capture):
    assert files_of(capture) == sorted(
        [
            "capture.json",
            "truth/truth.json",
            "truth/mesh.ply",
            "truth/abrdf.npz",
            "truth/heldout.json",
        ]
        + [f"photographs/v{v:03d}_l{l:03d}.exr" for v in range(3) for l in range(3)]  # noqa: E741
        + [f"silhouettes/v{v:03d}.png" for v in range(3)]
        + [f"truth/views/v{v:03d}.npz" for v in range(3)]
        + [
            f"truth/heldout/h{h:03d}{end}"
            for h in range(2)
            for end in (".exr", "_silhouette.png")
        ]
    )


def test_description_follows_the_schema(capture):
    description = json.loads((capture / "capture.json").read_text())
    jsonschema.validate(description, json.loads(SCHEMA.read_text()))


def test_bytes_do_not_depend_on_the_workers(capture, tmp_path):
    again = write_capture(scene(), tmp_path / "again", workers=3)
    same, different, missing = filecmp.cmpfiles(
        capture, again, files_of(capture), shallow=False
    )
    assert (different, missing) == ([], [])
    assert len(same) == 24


def test_photographs_are_half_floats_and_lie_within_the_silhouette(capture):
    image = read_exr(capture / "photographs" / "v001_l002.exr")
    coverage = np.asarray(Image.open(capture / "silhouettes" / "v001.png"))
    assert image.dtype == np.float16
    assert image.shape == (*coverage.shape, 3) == (20, 24, 3)
    assert coverage.max() == 255
    clean = read_exr(capture / "truth" / "heldout" / "h000.exr")
    empty = np.asarray(Image.open(capture / "truth" / "heldout" / "h000_silhouette.png")) == 0
    assert not clean[empty].any()
    assert clean[~empty].max() > 0


def test_radiance_beyond_half_floats_is_kept(tmp_path):
    bright = np.full((2, 3, 3), 1e6, np.float32)
    write_exr(tmp_path / "bright.exr", bright)
    assert (read_exr(tmp_path / "bright.exr") == bright).all()


def test_npz_holds_no_pickles_and_no_dates(tmp_path):
    arrays = {"number": np.array(3, np.int32), "table": np.arange(6.0).reshape(2, 3).T}
    write_npz(tmp_path / "a.npz", arrays)
    loaded = np.load(tmp_path / "a.npz", allow_pickle=False)
    assert loaded["number"].shape == ()
    assert np.array_equal(loaded["table"], arrays["table"])
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        assert {member.date_time for member in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    with pytest.raises(ValueError, match="pickle"):
        write_npz(tmp_path / "b.npz", {"thing": np.array([object()])})


def test_mesh_file_opens_elsewhere(tmp_path):
    import trimesh

    mesh = make_object({"preset": "sphere", "around": 16})
    write_ply(tmp_path / "ball.ply", mesh)
    again = trimesh.load(tmp_path / "ball.ply", process=False)
    ours = mesh.vertices.astype(np.float32)[mesh.faces]
    np.testing.assert_array_equal(again.vertices[again.faces], ours)


def test_an_earlier_capture_is_replaced_only_on_request(tmp_path):
    small = scene(heldout={"frames": 0}, truth={"points": 0, "per_view": False})
    target = write_capture(small, tmp_path / "capture")
    with pytest.raises(SceneError, match=r"capture: .*pass --overwrite to replace it"):
        write_capture(small, target)
    (target / "stale.txt").write_text("old")
    write_capture(small, target, overwrite=True)
    assert not (target / "stale.txt").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["capture"]


def test_other_folders_and_files_are_never_replaced(tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "final.tex").write_text("years of work")
    with pytest.raises(
        SceneError, match=r"thesis: expected an empty folder or an earlier capture"
    ):
        write_capture(scene(), tmp_path / "thesis", overwrite=True)
    with pytest.raises(SceneError, match=r"final\.tex: expected a folder"):
        write_capture(scene(), tmp_path / "thesis" / "final.tex", overwrite=True)
    assert (tmp_path / "thesis" / "final.tex").read_text() == "years of work"


def test_failure_leaves_nothing_behind(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise OSError("disk full")

    monkeypatch.setattr(capture_sim.write, "write_truth", fail)
    with pytest.raises(OSError, match="disk full"):
        write_capture(scene(), tmp_path / "capture")
    assert list(tmp_path.iterdir()) == []


def test_progress_counts_views_and_truth(tmp_path):
    steps = []
    write_capture(
        scene(), tmp_path / "c", progress=lambda done, total: steps.append((done, total))
    )
    assert steps == [(0, 4), (1, 4), (2, 4), (3, 4), (4, 4)]


def test_the_reader_reads_the_writer(capture):
    """Two packages that share no code agree on cameras, lights and pixels."""
    from reflfield.capture.readers import open_capture

    read = open_capture(capture)
    assert (len(read.cameras), len(read.lights), len(read.photographs)) == (3, 3, 9)
    truth = np.load(capture / "truth" / "views" / "v001.npz")
    row, column = np.nonzero(truth["label"] >= 0)
    position = truth["position"][row, column].astype(float)
    pixels, _ = read.cameras[1].project(position)
    centres = np.stack([column, row], axis=1) + 0.5
    np.testing.assert_allclose(pixels, centres, atol=1e-3)  # float32 positions
    light = np.array(read.lights[2].position)
    intensity = 1.0 * np.pi  # irradiance pi at 1 m
    distance2 = ((light - position) ** 2).sum(axis=1)
    np.testing.assert_allclose(
        read.lights[2].irradiance(position)[:, 0], intensity / distance2, rtol=1e-12
    )


def test_bracketed_exposures_merge_to_the_linear_photograph(tmp_path):
    from reflfield.capture.readers import open_capture

    plain = {"heldout": {"frames": 0}, "truth": {"points": 0, "per_view": False}}
    linear = write_capture(scene(effects={}, **plain), tmp_path / "linear")
    times = {"exposure_brackets": {"seconds": [0.02, 0.2, 2.0]}}
    bracketed = write_capture(scene(effects=times, **plain), tmp_path / "bracketed")
    description = json.loads((bracketed / "capture.json").read_text())
    jsonschema.validate(description, json.loads(SCHEMA.read_text()))
    expected = open_capture(linear).read_photograph(4)
    merged = open_capture(bracketed).read_photograph(4)
    assert expected.max() > 0.5  # two of the exposures saturate
    # Half a step of 1/255 near the dark end of a useful exposure is 2 % of its value;
    # the darkest value that the longest exposure tells from black is 1.5e-4.
    np.testing.assert_allclose(merged, expected, rtol=0.03, atol=2e-4)
