"""Random fields and threads for the tests of this package."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from reflfield.field.build import BaseSurface, FittedReflectance, build_field
from reflfield.field.indirect_light import IndirectLight
from reflfield.sphere.rotations import matrix_from_quaternion


def random_parts(rng, *, n_texels=60, n_clusters=3, n_components=4, view_side=4, light_side=3):
    frames = matrix_from_quaternion(rng.normal(size=(n_texels, 4)))
    texel_of_pixel = rng.integers(-1, n_texels, size=(9, 12))
    surface = BaseSurface(
        positions=rng.normal(size=(5, 3)),
        faces=rng.integers(0, 5, size=(7, 3)),
        uv=rng.random((5, 2)),
        texel_of_pixel=texel_of_pixel,
    )
    nodes = (view_side**2, light_side**2, 3)
    reflectance = FittedReflectance(
        local_from_world=frames,
        cluster=rng.integers(0, n_clusters, n_texels),
        coefficients=rng.normal(size=(n_texels, n_components)),
        mean=1.0 + rng.random((n_clusters, *nodes)),
        basis=0.2 * rng.normal(size=(n_clusters, n_components, *nodes)),
        indirect=IndirectLight(
            rng.normal(size=(3, 9, 3)).astype(np.float32),
            rng.normal(size=(n_texels, 2)).astype(np.float32),
        ),
    )
    return surface, reflectance


@pytest.fixture
def parts(rng):
    return random_parts(rng)


@pytest.fixture
def make_field(rng):
    """Return a function from the sizes of `random_parts` and options to a field."""

    def make(*, domain="cube_root", quantisation=None, metadata=None, **sizes):
        surface, fitted = random_parts(rng, **sizes)
        fitted = FittedReflectance(**{**vars(fitted), "domain": domain})
        return build_field(surface, fitted, quantisation=quantisation, metadata=metadata)

    return make


@pytest.fixture(scope="module")
def pool():
    with ThreadPoolExecutor(2) as pool:
        yield pool
