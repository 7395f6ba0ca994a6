"""Store: what is written by views is read by texels, in any order, or found damaged."""

import subprocess
import sys

import numpy as np
import pytest
import zarr

from reflfield.errors import InputError, ShapeError
from reflfield.observations import store
from reflfield.observations.photographed_pairs import PhotographedPairs
from reflfield.observations.store import (
    ObservationStore,
    Observed,
    check_place,
    chunk_shape,
    create_samples,
    is_written,
    open_samples,
    place_of,
)

# Photographs of two views under two lights.
FOUR = PhotographedPairs.product(2, 2)


def all_observed(n_texels, n_views, n_lights):
    return Observed(
        np.ones((n_texels, n_views), bool),
        np.ones((n_texels, n_lights), bool),
        PhotographedPairs.product(n_views, n_lights),
    )


@pytest.fixture
def written(tmp_path, rng, monkeypatch):
    """A store of 2500 texels (three chunks) written three views at a time, of seven."""
    monkeypatch.setattr(store, "VIEWS_PER_CHUNK", 3)
    monkeypatch.setattr(store, "MOST_TEXELS_PER_CHUNK", 1024)
    values = rng.random((2500, 28, 3)).astype(np.float16)
    samples = create_samples(tmp_path / "store", 2500, PhotographedPairs.product(7, 4))
    for first in range(0, 28, 12):
        samples[:, first : first + 12] = values[:, first : first + 12]
    return ObservationStore(tmp_path / "store", all_observed(2500, 7, 4)), values


class TestReading:
    def test_groups_of_views_that_do_not_divide_them(self, written):
        stored, values = written
        assert stored.samples.chunks[:2] == (1024, 12)
        assert np.array_equal(stored.read(slice(None)), values)

    @pytest.mark.parametrize(
        "texels",
        [
            [2499, 0, 1024, 1023],
            [5, 5, 5],
            [7],
            [],
            [2048, 3, 2048, 1500, 3],
            [3, 900, 1023, 1024, 1024, 2040, 2499],
            range(1000, 2500),
        ],
        ids=["unsorted", "repeated", "one", "none", "both", "ascending", "without gaps"],
    )
    def test_by_index(self, written, texels):
        stored, values = written
        texels = np.array(texels, np.intp)
        assert np.array_equal(stored.read(texels), values[texels])

    def test_by_slice_across_chunks(self, written):
        stored, values = written
        assert np.array_equal(stored.read(slice(1000, 2100)), values[1000:2100])

    def test_sizes(self, written):
        stored, values = written
        assert stored.n_texels == 2500
        assert stored.raw_bytes() == values.nbytes


class TestDamage:
    def test_a_changed_bit_is_found(self, written, tmp_path):
        stored, values = written
        chunk = tmp_path / "store" / "c" / "1" / "2" / "0"
        data = bytearray(chunk.read_bytes())
        data[len(data) // 2] ^= 4
        chunk.write_bytes(data)
        with pytest.raises(InputError, match=r"chunks that agree .* `from_stage"):
            stored.read(np.array([1500]))
        # Other chunks are as good as ever.
        assert np.array_equal(stored.read(slice(0, 1024)), values[:1024])
        assert not is_written(stored.samples, (slice(None), slice(24, 28)))
        assert is_written(stored.samples, (slice(None), slice(12, 24)))

    def test_a_lost_chunk_is_found(self, written, tmp_path):
        stored, _ = written
        (tmp_path / "store" / "c" / "2" / "1" / "0").unlink()
        with pytest.raises(InputError, match="found some missing"):
            stored.read(np.array([5, 2400]))
        assert not is_written(stored.samples, (slice(None), slice(12, 24)))
        assert is_written(stored.samples, (slice(None), slice(0, 12)))

    def test_chunks_of_zeros_are_not_taken_for_lost(self, tmp_path):
        samples = create_samples(tmp_path / "store", 5, PhotographedPairs.product(4, 2))
        assert not is_written(samples, (slice(None), slice(None)))
        samples[:] = 0
        assert is_written(samples, (slice(None), slice(None)))


class TestObjectStorage:
    def test_of_fsspec_holds_the_same(self, rng):
        values = rng.random((300, 45, 3)).astype(np.float16)
        url = "memory://test_store/samples"
        create_samples(url, 300, PhotographedPairs.product(9, 5))[:] = values
        stored = ObservationStore(url, all_observed(300, 9, 5))
        assert np.array_equal(stored.read(np.array([299, 4])), values[[299, 4]])

    @pytest.mark.parametrize("url", ["nosuch://a/b", "gdrive://a/b"])
    def test_without_a_file_system_is_named(self, url):
        with pytest.raises(InputError, match=f"{url}: expected a URL that fsspec can open"):
            create_samples(url, 3, FOUR)

    def test_a_local_url_is_a_folder(self, tmp_path):
        create_samples(f"file://{tmp_path}/s", 3, FOUR)[:] = 1
        assert (ObservationStore(tmp_path / "s", all_observed(3, 2, 2)).read([0]) == 1).all()


class TestCreation:
    @pytest.mark.parametrize(
        ("name", "n_texels", "pairs"),
        [("texels", 0, FOUR), ("photographs", 3, PhotographedPairs.of_table([[False]]))],
    )
    def test_counts_of_zero_are_refused(self, tmp_path, name, n_texels, pairs):
        with pytest.raises(InputError, match=f"{name}: expected at least one, received 0"):
            create_samples(tmp_path / "s", n_texels, pairs)
        assert not (tmp_path / "s").exists()

    def test_what_is_there_is_opened_again(self, tmp_path):
        create_samples(tmp_path / "s", 3, FOUR)[:] = 7
        assert (create_samples(tmp_path / "s", 3, FOUR)[:] == 7).all()

    def test_samples_of_another_shape_are_not_erased(self, tmp_path):
        create_samples(tmp_path / "s", 3, FOUR)[:] = 7
        with pytest.raises(InputError, match=r"s: expected .* shape \(4, 5, 3\) .* found"):
            create_samples(tmp_path / "s", 4, PhotographedPairs.product(1, 5))
        assert (zarr.open_array(tmp_path / "s", mode="r")[:] == 7).all()


class FailsOnce:
    """An opener that fails the first time, as a server does that is busy."""

    def __init__(self, failure):
        self.failure, self.open = failure, zarr.open_array

    def __call__(self, *words, **named):
        failure, self.failure = self.failure, None
        if failure is not None:
            raise failure
        return self.open(*words, **named)


class TestAFailureToOpenErasesNothing:
    @pytest.mark.parametrize(
        "failure",
        [
            PermissionError(13, "Permission denied"),
            OSError(5, "Input/output error"),
            TimeoutError("no answer"),
            ValueError("what no version of zarr says today"),
            KeyError("shape"),
        ],
        ids=lambda failure: type(failure).__name__,
    )
    @pytest.mark.parametrize("place", ["folder", "memory"])
    def test_transient(self, tmp_path, monkeypatch, failure, place):
        where = tmp_path / "s" if place == "folder" else f"memory://{failure!r:.4}/{place}"
        create_samples(where, 3, FOUR)[:] = 7
        kinds = (OSError, InputError)
        monkeypatch.setattr(zarr, "open_array", FailsOnce(type(failure)(*failure.args)))
        with pytest.raises(kinds) as raised:
            create_samples(where, 3, FOUR)
        named = getattr(raised.value, "filename", None) or str(raised.value)
        assert str(where) in named
        assert (create_samples(where, 3, FOUR)[:] == 7).all()

    @pytest.mark.parametrize("text", ["", "{", "[]", '{"zarr_format": 3}'])
    def test_damaged_description(self, tmp_path, text):
        create_samples(tmp_path / "s", 3, FOUR)[:] = 7
        described = (tmp_path / "s" / "zarr.json").read_bytes()
        (tmp_path / "s" / "zarr.json").write_text(text)
        with pytest.raises(InputError, match="s: expected samples, found a damaged"):
            create_samples(tmp_path / "s", 3, FOUR)
        (tmp_path / "s" / "zarr.json").write_bytes(described)
        assert (create_samples(tmp_path / "s", 3, FOUR)[:] == 7).all()

    def test_gone_it_is_not_made_by_who_only_writes_into_it(self, tmp_path):
        with pytest.raises(InputError, match="s: expected samples, found none"):
            open_samples(tmp_path / "s")
        assert not (tmp_path / "s").exists()


def test_the_end_of_a_process_waits_for_the_thread_of_zarr(tmp_path):
    """Which is busy for longer than zarr would wait."""
    code = (
        "import sys, time, zarr.core.sync\n"
        "from reflfield.observations.photographed_pairs import PhotographedPairs\n"
        "from reflfield.observations.store import create_samples\n"
        "create_samples(sys.argv[1], 3, PhotographedPairs.product(2, 2))\n"
        "zarr.core.sync.loop[0].call_soon_threadsafe(time.sleep, 0.5)\n"
    )
    words = [sys.executable, "-c", code, str(tmp_path / "s")]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


class TestChunks:
    @pytest.mark.parametrize("shape", [(1, 1, 1), (40_000, 149, 149), (200_000, 16, 1)])
    def test_chunks_are_of_a_useful_size(self, shape):
        n_texels, *counts = shape
        texels, photographs = chunk_shape(n_texels, PhotographedPairs.product(*counts))
        writer = n_texels * photographs * 6
        assert writer <= 128 << 20
        assert texels == n_texels or 256 <= texels <= 4096


class TestPlace:
    @pytest.fixture
    def folders(self, tmp_path, monkeypatch):
        """A capture, a folder of results, a home and a working folder."""
        monkeypatch.setenv("HOME", str(tmp_path / "home"))
        for name in ("capture/photographs", "out/stages", "home", "full/music"):
            (tmp_path / name).mkdir(parents=True)
        monkeypatch.chdir(tmp_path / "home")
        return {"capture": tmp_path / "capture", "out": tmp_path / "out"}

    @pytest.mark.parametrize(
        ("place", "reason"),
        [
            ("", "expected a folder or a URL, received ''"),
            (" ", "expected a folder or a URL, received ' '"),
            ("file://", "expected a folder or a URL"),
            ("/", "the root of the file system"),
            ("file:///", "the root of the file system"),
            ("//", "the root of the file system"),
            ("s3://", "expected a place"),
            ("memory:///", "expected a place"),
            (".", "the home folder"),
            ("{}/home", "the home folder"),
            ("{}/capture", "in the capture's folder"),
            ("{}/capture/photographs/new", "in the capture's folder"),
            ("{}/out/../capture", "in the capture's folder"),
            ("{}/out", "the folder of the results"),
            ("{}/out/stages", "the folder of the results"),
            ("{}/out/stages/observations/new", "the folder of the results"),
            ("{}/full", "which holds 'music'"),
            ("file://{}/full", "which holds 'music'"),
        ],
    )
    def test_in_use_is_refused(self, folders, tmp_path, place, reason):
        with pytest.raises(InputError, match=f"store: .*{reason}"):
            check_place(place.format(tmp_path), **folders)

    @pytest.mark.parametrize("place", ["{}/new/deep", "{}/empty", "{}/ours", "{}/out/samples",
                                       "s3://bucket", "memory://name", "relative"])  # fmt: skip
    def test_of_samples_alone(self, folders, tmp_path, place):
        for name in ("empty", "ours/samples-0123456789abcdef", "ours/lost+found"):
            (tmp_path / name).mkdir(parents=True)
        check_place(place.format(tmp_path), **folders)

    def test_is_named_from_the_root(self, tmp_path, monkeypatch):
        """A run from another folder finds it again."""
        monkeypatch.chdir(tmp_path)
        assert place_of("samples", "f" * 64) == f"{tmp_path}/samples/samples-ffffffffffffffff"


class TestObserved:
    def test_count_is_that_of_the_triples(self, rng):
        observed = Observed(
            rng.random((50, 7)) < 0.5,
            rng.random((50, 4)) < 0.5,
            PhotographedPairs.of_table(rng.random((7, 4)) < 0.5),
        )
        triples = observed.views[:, :, None] & observed.lights[:, None] & observed.pairs.table
        assert observed.count() == triples.sum()

    def test_count_beyond_the_digits_of_float32(self):
        # 2001 * 131 * 129 is odd and above 2^24: float32 has no such number.
        assert all_observed(2001, 131, 129).count() == 33_814_899

    def test_shapes_that_disagree(self):
        seen = np.ones((3, 2), bool)
        with pytest.raises(ShapeError, match="lights"):
            Observed(seen, np.ones((4, 2), bool), FOUR)
        with pytest.raises(ShapeError, match="lights"):
            Observed(seen, np.ones((3, 5), bool), FOUR)
        with pytest.raises(ShapeError, match="views"):
            Observed(np.ones((3, 5), bool), np.ones((3, 2), bool), FOUR)
