"""Store: what is written by views is read by texels, in any order."""

import numpy as np
import pytest

from reflfield.errors import InputError, ShapeError
from reflfield.observations.store import ObservationStore, Observed, create_samples


def all_observed(n_texels, n_views, n_lights):
    return Observed(
        np.ones((n_texels, n_views), bool),
        np.ones((n_texels, n_lights), bool),
        np.ones((n_views, n_lights), bool),
    )


@pytest.fixture
def written(tmp_path, rng):
    """A store of 2500 texels (three chunks) written three views at a time, of seven."""
    values = rng.random((2500, 7, 4, 3)).astype(np.float16)
    samples = create_samples(tmp_path / "store", 2500, 7, 4, 3)
    for first in range(0, 7, 3):
        samples[:, first : first + 3] = values[:, first : first + 3]
    return ObservationStore(tmp_path / "store", all_observed(2500, 7, 4)), values


class TestReading:
    def test_groups_of_views_that_do_not_divide_them(self, written):
        store, values = written
        assert store.samples.chunks[:2] == (1024, 3)
        assert np.array_equal(store.read(slice(None)), values)

    @pytest.mark.parametrize(
        "texels",
        [[2499, 0, 1024, 1023], [5, 5, 5], [7], [], [2048, 3, 2048, 1500, 3]],
        ids=["unsorted", "repeated", "one", "none", "both"],
    )
    def test_by_index(self, written, texels):
        store, values = written
        texels = np.array(texels, np.intp)
        assert np.array_equal(store.read(texels), values[texels])

    def test_by_slice_across_chunks(self, written):
        store, values = written
        assert np.array_equal(store.read(slice(1000, 2100)), values[1000:2100])

    def test_what_was_never_written_is_zero(self, tmp_path):
        samples = create_samples(tmp_path / "store", 5, 4, 2, 2)
        samples[:, :2] = 1
        store = ObservationStore(tmp_path / "store", all_observed(5, 4, 2))
        assert (store.read(np.arange(5))[:, 2:] == 0).all()
        assert (store.read(np.arange(5))[:, :2] == 1).all()

    def test_sizes(self, written):
        store, values = written
        assert store.n_texels == 2500
        assert store.raw_bytes() == values.nbytes


class TestCreation:
    @pytest.mark.parametrize("name", ["texels", "views", "lights"])
    def test_counts_of_zero_are_refused(self, tmp_path, name):
        counts = {"texels": 3, "views": 2, "lights": 2, name: 0}
        with pytest.raises(InputError, match=f"{name}: expected at least one, received 0"):
            create_samples(tmp_path / "s", *counts.values(), 1)
        assert not (tmp_path / "s").exists()

    def test_replaces_what_was_there(self, tmp_path):
        create_samples(tmp_path / "s", 3, 2, 2, 1)[:] = 7
        assert create_samples(tmp_path / "s", 4, 1, 5, 8).shape == (4, 1, 5, 3)
        store = ObservationStore(tmp_path / "s", all_observed(4, 1, 5))
        assert not store.read(slice(None)).any()


class TestObserved:
    def test_count_is_that_of_the_triples(self, rng):
        observed = Observed(
            rng.random((50, 7)) < 0.5, rng.random((50, 4)) < 0.5, rng.random((7, 4)) < 0.5
        )
        triples = observed.views[:, :, None] & observed.lights[:, None] & observed.pairs
        assert observed.count() == triples.sum()

    def test_count_beyond_the_digits_of_float32(self):
        # 2001 * 131 * 129 is odd and above 2^24: float32 has no such number.
        assert all_observed(2001, 131, 129).count() == 33_814_899

    def test_shapes_that_disagree(self):
        seen = np.ones((3, 2), bool)
        with pytest.raises(ShapeError, match="lights"):
            Observed(seen, np.ones((4, 2), bool), np.ones((2, 2), bool))
        with pytest.raises(ShapeError, match="pairs"):
            Observed(seen, np.ones((3, 5), bool), np.ones((5, 2), bool))
        with pytest.raises(ShapeError, match="views"):
            Observed(np.ones(3, bool), np.ones((3, 5), bool), np.ones((5, 2), bool))
