"""Captures that are no product of views and lights: samples of what was photographed alone."""

import json
import shutil

import numpy as np
import pytest

from reflfield.observations.store import open_samples

N_VIEWS, N_LIGHTS = 10, 6
RNG = np.random.default_rng(7)
# Light of each photograph, by kind of capture; views (rows) and lights (columns).
KINDS = {
    "one light for each view": np.arange(N_LIGHTS) == np.arange(N_VIEWS)[:, None] % N_LIGHTS,
    "one view for each light": np.arange(N_VIEWS)[:, None]
    == (np.arange(N_LIGHTS) * 7) % N_VIEWS,
    "a third of the pairs missing": RNG.random((N_VIEWS, N_LIGHTS)) > 1 / 3,
}


@pytest.fixture(scope="module")
def product(tiny_capture, tiny_options, subprocess_run, tmp_path_factory):
    """A run of every view under every light, as far as the samples."""
    out = tmp_path_factory.mktemp("product") / "out"
    outcome = subprocess_run(
        *("-m", "reflfield", "run", tiny_capture, "-o", out, "--config", tiny_options),
        *("--until", "observations"),
    )
    assert outcome.status == 0, outcome.err
    return out


def samples_in(out):
    return open_samples(out / "stages" / "observations" / "samples", "r")


@pytest.mark.parametrize("kind", KINDS)
def test_samples_are_those_of_the_product_that_were_photographed(
    kind, product, capture_copy, described, reflfield, tiny_options, tmp_path
):
    photographed = KINDS[kind]

    def edit(document):
        names = ([one["id"] for one in document[what]] for what in ("cameras", "lights"))
        cameras, lights = names
        document["photographs"] = [
            {"camera": cameras[i], "light": lights[j],
             "file": f"photographs/{cameras[i]}_{lights[j]}.exr"}
            for i, j in np.argwhere(photographed)
        ]  # fmt: skip
        document.pop("truth", None)

    described(capture_copy, edit)
    out = shutil.copytree(product, tmp_path / "out")
    words = ("--config", tiny_options, "--until", "observations")
    outcome = reflfield("run", capture_copy, "-o", out, *words)
    assert outcome.status == 0, outcome.err
    whole, sparse = samples_in(product), samples_in(out)
    n_texels = whole.shape[0]
    assert whole.shape == (n_texels, N_VIEWS * N_LIGHTS, 3)
    assert sparse.shape == (n_texels, photographed.sum(), 3)
    # The units of the two captures are powers of two.
    values = whole[:].astype(np.float64) * whole.attrs["unit"]
    expected = values.reshape(n_texels, N_VIEWS, N_LIGHTS, 3)[:, photographed]
    np.testing.assert_array_equal(sparse[:].astype(np.float64) * sparse.attrs["unit"], expected)
    counted = json.loads((out / "stages" / "observations" / "stage.json").read_text())
    assert counted["counts"]["photographs"] == photographed.sum()
