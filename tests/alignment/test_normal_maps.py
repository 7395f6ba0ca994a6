import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reflfield.alignment import local_map, world_map
from reflfield.errors import InputError, ShapeError


def test_world_map_is_the_local_axis_carried_by_the_base_frame():
    local, base = (Rotation.random(5, random_state=s).as_matrix() for s in (1, 2))
    pixels = np.array([[4, 0], [-1, 2]])
    shown = world_map(local, base, pixels, "tangent")
    for (row, column), texel in np.ndenumerate(pixels):
        expected = base[texel].T @ local[texel, 0] if texel >= 0 else np.zeros(3)
        np.testing.assert_allclose(shown[row, column], expected, atol=1e-6)  # float32


def test_bad_maps_are_refused():
    with pytest.raises(InputError, match="axis"):
        local_map(np.eye(3)[None], np.zeros((1, 1), int), "up")
    with pytest.raises(InputError, match="texel_of_pixel"):
        local_map(np.eye(3)[None], np.ones((1, 1), int))
    with pytest.raises(ShapeError, match="base_from_world"):
        world_map(np.eye(3)[None], np.tile(np.eye(3), (2, 1, 1)), np.zeros((1, 1), int))
