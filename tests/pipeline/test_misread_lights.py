"""Lights in other axes than the cameras are said on the command line."""

import pytest


@pytest.mark.parametrize("turned", [False, True])
def test_lights_with_y_up_among_cameras_with_z_up(
    run_tiny, capture_copy, described, tmp_path, turned
):
    def turn(document):
        for light in document["lights"]:
            x, y, z = light["position"]
            light["position"] = [x, z, -y]

    if turned:
        described(capture_copy, turn)
    outcome = run_tiny(tmp_path / "out", "--until", "observations", capture=capture_copy)
    assert outcome.status == 0
    said = "lights and photographs do not fit" in outcome.err
    assert said == turned
    assert ("coordinates read as (x, -z, y)" in outcome.err) == turned
