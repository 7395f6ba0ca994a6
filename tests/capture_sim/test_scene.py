"""Scene files: what is accepted, and how mistakes are reported."""

import logging

import numpy as np
import pytest

from capture_sim import cli
from capture_sim.errors import SceneError
from capture_sim.scene import find_scene, load_scene, parse_scene, shipped_scenes


def tables(**changed):
    good = {
        "object": {"preset": "sphere"},
        "material": {"preset": "grey_card"},
        "cameras": {"preset": "rti"},
        "lights": {"preset": "rti", "n": 3},
    }
    return {**good, **changed}


def test_defaults():
    scene = parse_scene(tables(), default_name="ball")
    assert (scene.name, scene.base_geometry, scene.heldout_photographs) == ("ball", "hull", 0)
    assert (scene.image.samples_per_side, scene.image.edge_samples_per_side) == (2, 4)
    assert (scene.effects.simulate, scene.effects.tolerance) == ("auto", 1e-3)
    assert scene.effects.parameters == ()


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"colour": 1}, r"scene: expected keys .*base_geometry.*, received 'colour'; remove"),
        ({"seed": -1}, r"scene\.seed: expected a whole number"),
        ({"seed": True}, r"scene\.seed"),
        ({"name": 3}, r"scene\.name: expected one line of text, received 3"),
        ({"base_geometry": "round"}, r"scene\.base_geometry: expected one of hull, plane"),
        (
            {"object": "vase"},
            r"scene\.object: expected a table, received vase; write a \[object\]",
        ),
        ({"object": {"preset": "cup"}}, r"object\.preset: expected one of .*vase"),
        ({"material": {"preset": "mud"}}, r"material\.preset"),
        ({"cameras": {"preset": "rti", "zoom": 2}}, r"cameras: expected keys .*'zoom'"),
        ({"image": {"samples_per_side": 0}}, r"image\.samples_per_side: .*received 0"),
        ({"image": {"samples": 4}}, r"image: expected keys .*samples_per_side.*'samples'"),
        ({"effects": "some"}, r"effects: expected auto, all, none or a list.*received some"),
        ({"effects": ["glow"]}, r"effects: expected names among .*shadows.*'glow'"),
        ({"effects": 3}, r"effects: expected a table, received 3"),
        ({"effects": {"glow": "on"}}, r"effects: expected keys .*shadows.*received 'glow'"),
        ({"effects": {"simulate": 1}}, r"effects\.simulate: expected auto, all, none"),
        ({"effects": {"tolerance": -1}}, r"effects\.tolerance: expected a number in \[0, 1\]"),
        ({"effects": {"shadows": "maybe"}}, r"effects\.shadows: .* one of auto, on, off"),
        ({"effects": {"shadows": {"soft": 1}}}, r"effects\.shadows: expected keys none"),
        (
            {"effects": {"sensor_noise": {"read_noise": -1}}},
            r"effects\.sensor_noise\.read_noise: expected a number",
        ),
        (
            {"effects": {"exposure_brackets": {"seconds": [1.0, 0.0]}}},
            r"exposure_brackets\.seconds: expected a number",
        ),
        (
            {"effects": {"exposure_brackets": {"seconds": 1.0}}},
            r"exposure_brackets\.seconds: expected a list",
        ),
        ({"heldout": {"photographs": -2}}, r"heldout\.photographs"),
        ({"truth": {"per_view": 1}}, r"truth\.per_view: expected true or false"),
    ],
)
def test_mistakes_name_the_key(changed, named):
    with pytest.raises(SceneError, match=named):
        parse_scene(tables(**changed))


@pytest.mark.parametrize("key", ["object", "material", "cameras", "lights"])
def test_missing_tables_are_named(key):
    incomplete = tables()
    del incomplete[key]
    with pytest.raises(SceneError, match=rf"scene\.{key}: expected a value, received nothing"):
        parse_scene(incomplete)


def test_heldout_photographs_need_a_perspective_camera():
    orthographic = {"preset": "rti", "model": "orthographic"}
    with pytest.raises(SceneError, match=r"heldout\.photographs: expected 0 for cameras other"):
        parse_scene(tables(cameras=orthographic, heldout={"photographs": 1}))


class TestRenamedKey:
    """Scenes of earlier versions call the held-out photographs `frames`."""

    def test_the_old_name_is_read_with_one_line(self, caplog):
        with caplog.at_level(logging.WARNING, logger="capture_sim"):
            scene = parse_scene(tables(heldout={"frames": 3}))
        assert scene.heldout_photographs == 3
        (record,) = caplog.records
        assert record.getMessage() == (
            "heldout.frames is now heldout.photographs; the old name is accepted until "
            "version 0.2"
        )

    def test_the_new_name_is_read_without_a_word(self, caplog):
        with caplog.at_level(logging.WARNING, logger="capture_sim"):
            scene = parse_scene(tables(heldout={"photographs": 3}))
        assert (scene.heldout_photographs, caplog.records) == (3, [])

    def test_both_names_are_refused(self):
        with pytest.raises(
            SceneError,
            match=r"heldout\.photographs, heldout\.frames: expected one of the two, received "
            r"both; remove heldout\.frames$",
        ):
            parse_scene(tables(heldout={"photographs": 3, "frames": 3}))

    def test_the_command_says_it_on_one_line(self, monkeypatch, capsys):
        def warn():
            parse_scene(tables(heldout={"frames": 3}))

        monkeypatch.setattr(cli, "app", warn)
        cli.main()
        error = capsys.readouterr().err.splitlines()
        assert len(error) == 1
        assert error[0].startswith("capture-sim: note: heldout.frames is now")


def test_textures_need_coordinates(tmp_path):
    (tmp_path / "bare.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    bare = {"type": "mesh", "file": "bare.obj"}
    assert not parse_scene(tables(object=bare), folder=tmp_path).mesh.has_uv
    with pytest.raises(SceneError, match="texture coordinates, which the material needs"):
        parse_scene(tables(object=bare, material={"preset": "greek_key"}), folder=tmp_path)


def test_files_are_named_in_messages(tmp_path):
    broken = tmp_path / "broken.toml"
    broken.write_text("[object\n")
    with pytest.raises(SceneError, match=r"broken\.toml: expected a TOML file"):
        load_scene(str(broken))
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("shine = 1\n[object]\npreset = 'sphere'\n")
    with pytest.raises(SceneError, match=r"wrong\.toml: scene\.material"):
        load_scene(str(wrong))


def test_unknown_scenes_list_the_shipped_ones():
    with pytest.raises(SceneError, match=r"one of .*demo_vase, .*received 'nothing_like_it'"):
        find_scene("nothing_like_it")


@pytest.mark.parametrize("name", shipped_scenes())
def test_shipped_scenes_load_and_hold_their_object_in_the_picture(name):
    scene = load_scene(name)
    assert scene.name == name
    assert scene.description
    for camera in scene.cameras:
        pose = np.array(camera["camera_from_world"])
        local = scene.mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
        depth = np.ones((1, 1)) if camera["model"] == "orthographic" else local[:, 2:]
        pixels = local[:, :2] / depth * camera["fl_x"] + [camera["cx"], camera["cy"]]
        assert (depth > 0).all()
        assert (pixels > 0).all()
        assert (pixels < [camera["w"], camera["h"]]).all()
