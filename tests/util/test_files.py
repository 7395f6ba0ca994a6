"""Files: only regular ones are opened, sizes are bounded, what is written is whole."""

import os
import zipfile
from pathlib import Path

import numpy as np
import pytest

from reflfield.errors import CaptureError, InputError
from reflfield.util.files import (
    check_regular,
    filling,
    load_array,
    load_arrays,
    read_bytes,
    replacing,
)

MOST = 1 << 20


def test_regular_file_has_a_size(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    assert check_regular(tmp_path / "a") == 3


@pytest.mark.timeout(10)
def test_named_pipe_is_refused_unopened(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(CaptureError, match="pipe: expected a file, received a named pipe"):
        check_regular(tmp_path / "pipe", CaptureError)


@pytest.mark.parametrize(("path", "kind"), [("/dev/zero", "a device"), ("/", "a folder")])
def test_devices_and_folders_are_refused(tmp_path, path, kind):
    with pytest.raises(InputError, match=f"received {kind}"):
        read_bytes(tmp_path / path, MOST)


def test_large_file_is_refused_unread(tmp_path):
    with (tmp_path / "large").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(InputError, match=r"large: expected at most 1,048,576 bytes"):
        read_bytes(tmp_path / "large", MOST)


def test_arrays_come_back(tmp_path):
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.array([True, False])}
    np.savez_compressed(tmp_path / "x.npz", **arrays)
    loaded = load_arrays(tmp_path / "x.npz", MOST)
    assert set(loaded) == {"a", "b"}
    assert all(np.array_equal(loaded[name], arrays[name]) for name in arrays)


def test_pickled_arrays_are_refused(tmp_path):
    np.savez(tmp_path / "x.npz", a=np.array([print], dtype=object))
    with pytest.raises(InputError, match="pickled"):
        load_arrays(tmp_path / "x.npz", MOST)


def test_header_that_claims_terabytes_is_refused(tmp_path):
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1099511627776,), }"
    text = header.ljust(117) + b"\n"
    content = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text
    with zipfile.ZipFile(tmp_path / "x.npz", "w") as archive:
        archive.writestr("a.npy", content)
    with pytest.raises(InputError, match="claims 8,796,093,022,208 bytes"):
        load_arrays(tmp_path / "x.npz", MOST)


def test_a_header_that_is_no_python_is_refused(tmp_path):
    np.save(tmp_path / "x.npy", np.zeros(3))
    whole = (tmp_path / "x.npy").read_bytes()
    (tmp_path / "x.npy").write_bytes(whole.replace(b"}", b" "))
    with pytest.raises(InputError, match=r"x\.npy: expected an array in an npy file"):
        load_array(tmp_path / "x.npy", MOST)


def test_array_that_inflates_is_refused(tmp_path):
    np.savez_compressed(tmp_path / "x.npz", a=np.zeros(MOST, np.float64))
    with pytest.raises(InputError, match="expected arrays of at most 1,048,576 bytes"):
        load_arrays(tmp_path / "x.npz", MOST)


def test_damaged_arrays_are_one_error(tmp_path, rng):
    np.savez_compressed(tmp_path / "x.npz", a=rng.normal(size=50))
    whole = (tmp_path / "x.npz").read_bytes()
    damaged = [whole[:n] for n in range(0, len(whole), 7)]
    for position in range(0, len(whole), 3):
        changed = bytearray(whole)
        changed[position] ^= 0x55
        damaged.append(bytes(changed))
    for content in damaged:
        (tmp_path / "y.npz").write_bytes(content)
        assert says_or_reads(tmp_path / "y.npz")


def says_or_reads(path):
    """Whether an error names the file; a flipped date of a member changes nothing."""
    try:
        loaded = load_arrays(path, MOST)
    except InputError as error:
        return path.name in str(error)
    return all(array.shape == (50,) for array in loaded.values())


@pytest.mark.parametrize("writing", [replacing, filling])
def test_a_full_disk_is_named_where_the_system_names_nothing(tmp_path, writing):
    def fill():
        with writing(tmp_path / "x"), Path("/dev/full").open("w") as full:
            full.write("a")

    with pytest.raises(OSError, match=r"No space left on device: '.*/x'"):
        fill()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("writing", [replacing, filling])
def test_content_is_on_the_disk_before_it_has_its_name(tmp_path, order_of_writes, writing):
    with writing(tmp_path / "x") as partial:
        (partial / "y" if partial.is_dir() else partial).write_text("whole")
    (file,) = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert order_of_writes(file) == ["flushed", "named"]


def test_failed_write_leaves_the_earlier_file(tmp_path):
    path = tmp_path / "x"
    path.write_text("earlier")

    def fail():
        with replacing(path) as partial:
            partial.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert path.read_text() == "earlier"
    assert [entry.name for entry in tmp_path.iterdir()] == ["x"]
