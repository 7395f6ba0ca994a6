"""Packing of arrays: identity for every type and filter, and what it is good for."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from reflfield.field.array_coding import (
    CONTEXT_BITS,
    FILTERS,
    LARGE_BYTES,
    SHORT_DISTANCE,
    pack,
    packed_array,
    unpack,
)

TYPES = ("int8", "int16", "int32", "uint8", "uint16", "float32")


@given(
    array=st.sampled_from(TYPES).flatmap(
        lambda name: npst.arrays(name, npst.array_shapes(max_dims=3, max_side=4))
    ),
    kind=st.sampled_from(FILTERS),
)
def test_packing_is_undone(array, kind):
    if kind != "none" and array.dtype.kind == "f":
        return
    if kind == "fresh":
        array = np.abs(array.astype(np.int32)) % 1000
    for bits in CONTEXT_BITS:
        content = pack(array, kind, bits)
        again = unpack(content, array.dtype, array.shape, kind, bits)
    assert again.dtype == array.dtype
    assert again.tobytes() == array.tobytes()


def test_laplacian_codes_come_close_to_their_entropy(rng):
    codes = np.rint(rng.laplace(scale=3.0, size=20_000)).astype(np.int16)
    shares = np.unique(codes, return_counts=True)[1] / codes.size
    entropy = -np.sum(shares * np.log2(shares)) * codes.size / 8
    assert min(len(pack(codes, "none", bits)) for bits in CONTEXT_BITS) < 1.05 * entropy + 100


@pytest.mark.parametrize("damage", [b"", b"\x00", b"\xff" * 50])
def test_foreign_bytes_are_refused(damage):
    with pytest.raises(ValueError, match=r"expected|damaged"):
        unpack(damage, np.dtype("int16"), (30,), "none", 0)


def test_way_of_a_large_array_is_that_of_its_first_rows(rng):
    ramp = np.cumsum(rng.integers(0, 3, (LARGE_BYTES // 4 + 10, 1)), axis=0).astype(np.int32)
    packed = packed_array("positions", ramp)
    assert packed.filter == "delta"
    again = unpack(packed.content, ramp.dtype, ramp.shape, packed.filter, packed.context_bits)
    assert again.tobytes() == ramp.tobytes()


def test_large_arrays_repeat_themselves_over_a_short_distance_alone(rng):
    """Matches are looked for in the cache, whatever the size; any reader can read them."""
    block = rng.integers(-128, 128, (SHORT_DISTANCE * 2, 1)).astype(np.int8)
    array = np.tile(block, (-(-LARGE_BYTES // len(block)) + 1, 1))
    packed = pack(array, "none", 0)
    assert len(packed) > 0.9 * array.nbytes
    np.testing.assert_array_equal(unpack(packed, array.dtype, array.shape, "none", 0), array)
    few = array[: 3 * len(block)]
    assert len(pack(few, "none", 0)) < 0.5 * few.nbytes
