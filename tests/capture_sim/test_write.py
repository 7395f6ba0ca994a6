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
from capture_sim.fingerprint import fingerprint
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
            "heldout": {"photographs": 2},
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
            "files.json",
            "truth/truth.json",
            "truth/mesh.ply",
            "truth/abrdf.npz",
            "truth/heldout.json",
            "truth/effects.json",
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
    files = [name for name in files_of(capture) if name != "truth/effects.json"]  # times
    same, different, missing = filecmp.cmpfiles(capture, again, files, shallow=False)
    assert (different, missing) == ([], [])
    assert len(same) == 25


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
    small = scene(heldout={"photographs": 0}, truth={"points": 0, "per_view": False})
    target = write_capture(small, tmp_path / "capture")
    with pytest.raises(SceneError, match=r"capture: .*pass --overwrite to replace it"):
        write_capture(small, target)
    write_capture(
        scene(heldout={"photographs": 1}, truth={"points": 0}), target, overwrite=True
    )
    assert (target / "truth" / "heldout.json").is_file()
    write_capture(small, target, overwrite=True)
    assert not (target / "truth" / "views").exists()
    assert not (target / "truth" / "heldout.json").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["capture"]
    assert sorted(p.name for p in target.iterdir()) == [
        *("capture.json", "files.json", "photographs", "silhouettes", "truth")
    ]


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


def test_an_interrupted_capture_goes_on_by_photograph(capture, tmp_path, monkeypatch):
    whole, written = capture_sim.write.write_exr, []

    def interrupted(path, values):
        if len(written) == 4:
            path.write_bytes(b"half a file")
            raise OSError("disk full")
        written.append(path.name)
        whole(path, values)

    monkeypatch.setattr(capture_sim.write, "write_exr", interrupted)
    with pytest.raises(OSError, match="disk full"):
        write_capture(scene(), tmp_path / "again")
    assert not (tmp_path / "again").exists()
    monkeypatch.setattr(
        capture_sim.write, "write_exr", lambda p, v: (written.append(p.name), whole(p, v))
    )
    again = write_capture(scene(), tmp_path / "again")
    assert len(written) == len(set(written)) == 9  # each of them once
    files = [name for name in files_of(capture) if name != "truth/effects.json"]
    assert files_of(again) == files_of(capture)
    assert filecmp.cmpfiles(capture, again, files, shallow=False)[1:] == ([], [])
    assert [path.name for path in tmp_path.iterdir()] == ["again"]


def test_what_was_begun_for_another_scene_is_not_taken_over(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise OSError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(capture_sim.write, "write_truth", fail)
        with pytest.raises(OSError, match="disk full"):
            write_capture(scene(seed=7), tmp_path / "again")
    assert [path.name for path in tmp_path.iterdir()] == [".again.incomplete"]
    written = []
    whole = capture_sim.write.write_exr
    monkeypatch.setattr(
        capture_sim.write, "write_exr", lambda p, v: (written.append(p.name), whole(p, v))
    )
    write_capture(scene(), tmp_path / "again")
    assert len(written) == 9


@pytest.mark.parametrize(
    "changed",
    [
        {"seed": 2},
        {"material": {"preset": "painted_vase", "labels": {"type": "bands"}}},
        {"object": {"preset": "vase", "around": 48, "along": 33}},
        {"effects": {"shadows": "off"}},
    ],
)
def test_fingerprints_tell_scenes_apart(changed):
    assert fingerprint(scene()) == fingerprint(scene())
    assert fingerprint(scene(**changed)) != fingerprint(scene())


def test_progress_counts_photographs(tmp_path, monkeypatch):
    """By one, whichever thread writes them; and on from where an earlier call stopped."""
    steps, whole = [], capture_sim.write.write_exr

    def failing(path, values):
        if len(steps) == 5:
            raise OSError("disk full")
        whole(path, values)

    def report(done, total):
        steps.append((done, total))

    monkeypatch.setattr(capture_sim.write, "write_exr", failing)
    with pytest.raises(OSError, match="disk full"):
        write_capture(scene(), tmp_path / "c", progress=report)
    assert steps == [(n, 9) for n in range(5)]
    monkeypatch.setattr(capture_sim.write, "write_exr", whole)
    steps.clear()
    write_capture(scene(), tmp_path / "c", workers=3, progress=report)
    assert steps == [(n, 9) for n in range(4, 10)]


def test_the_reader_reads_the_writer(capture, rounding):
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
        read.lights[2].irradiance(position)[:, 0], intensity / distance2, rounding(np.float64)
    )


def test_bracketed_exposures_merge_to_the_linear_photograph(tmp_path):
    from reflfield.capture.readers import open_capture

    plain = {"heldout": {"photographs": 0}, "truth": {"points": 0, "per_view": False}}
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


@pytest.fixture(scope="module")
def erring(tmp_path_factory):
    """Capture of a rig that errs, with what each effect contributed to two photographs."""
    tables = {
        "pose_error": {},
        "light_variation": {},
        "dropped_photographs": {"fraction": 0.3},
        "quantisation": {"bits": 6},
    }
    folder = tmp_path_factory.mktemp("captures") / "erring"
    plain = {"heldout": {"photographs": 1}, "truth": {"points": 0, "per_view": False}}
    return write_capture(scene(effects=tables, **plain), folder, n_contributions=2)


def test_the_plan_is_kept_with_what_it_took(erring):
    record = json.loads((erring / "truth" / "effects.json").read_text())
    assert record["simulate"] == "auto"
    lines = {line["name"]: line for line in record["effects"]}
    on = {name for name, line in lines.items() if line["on"]}
    assert on >= {"pose_error", "light_variation", "quantisation", "shadows", "near_lights"}
    assert "defocus" not in on
    for name in ("quantisation", "shadows", "near_lights", "antialiasing"):
        assert lines[name]["seconds"] > 0.0, name
    assert lines["interreflection"]["on"] or lines["interreflection"]["contribution"] >= 0.0
    for name in on - {"dropped_photographs"}:
        bound = lines[name]["bound"]
        assert lines[name]["threshold"] < lines[name]["contribution"], name
        assert bound is None or lines[name]["contribution"] <= bound, name
    assert lines["defocus"]["seconds"] == 0.0


def test_differences_of_each_effect_are_written_on_demand(erring, capture):
    difference = read_exr(erring / "truth" / "contributions" / "quantisation" / "v000_l000.exr")
    assert difference.shape == (20, 24, 3)
    step = 4.0 / 63
    assert 0.0 < np.abs(difference).max() <= step / 2 * 1.01  # half floats round
    assert not (capture / "truth" / "contributions").exists()


def test_missing_photographs_are_neither_written_nor_listed(erring):
    listed = json.loads((erring / "capture.json").read_text())["photographs"]
    assert isinstance(listed, list)
    assert 0 < len(listed) < 9
    assert {entry["file"] for entry in listed} == {
        str(path.relative_to(erring)) for path in (erring / "photographs").iterdir()
    }


def test_the_real_rig_is_kept_beside_the_reported_one(erring, capture):
    reported = json.loads((erring / "capture.json").read_text())
    real = json.loads((erring / "truth" / "rig.json").read_text())
    assert real["cameras"][0]["id"] == reported["cameras"][0]["id"]
    assert (
        real["cameras"][0]["camera_from_world"] != reported["cameras"][0]["camera_from_world"]
    )
    assert real["lights"][0]["intensity"] != reported["lights"][0]["intensity"]
    ideal = json.loads((capture / "capture.json").read_text())
    assert reported["cameras"] == ideal["cameras"]
    assert not (capture / "truth" / "rig.json").exists()


def test_held_out_photographs_are_free_of_errors(erring, capture):
    ours = read_exr(erring / "truth" / "heldout" / "h000.exr")
    np.testing.assert_array_equal(ours, read_exr(capture / "truth" / "heldout" / "h000.exr"))


def test_calibrated_distortion_reaches_the_reader(tmp_path):
    from reflfield.capture.readers import open_capture

    bent = scene(
        effects={"lens_distortion": {"k1": -0.3, "k2": 0.1, "p1": 1e-3}},
        heldout={"photographs": 0},
        truth={"points": 0},
    )
    folder = write_capture(bent, tmp_path / "bent")
    read = open_capture(folder)
    truth = np.load(folder / "truth" / "views" / "v001.npz")
    row, column = np.nonzero(truth["label"] >= 0)
    pixels, _ = read.cameras[1].project(truth["position"][row, column].astype(float))
    centres = np.stack([column, row], axis=1) + 0.5
    np.testing.assert_allclose(pixels, centres, atol=1e-3)  # float32 positions
