"""Packing of arrays: identity for every type and filter, and what it is good for."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from reflfield.field.array_coding import FILTERS, pack, unpack

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
    content, bits = pack(array, kind)
    again = unpack(content, array.dtype, array.shape, kind, bits)
    assert again.dtype == array.dtype
    assert again.tobytes() == array.tobytes()


def test_laplacian_codes_come_close_to_their_entropy(rng):
    codes = np.rint(rng.laplace(scale=3.0, size=20_000)).astype(np.int16)
    shares = np.unique(codes, return_counts=True)[1] / codes.size
    entropy = -np.sum(shares * np.log2(shares)) * codes.size / 8
    assert len(pack(codes, "none")[0]) < 1.05 * entropy + 100


@pytest.mark.parametrize("damage", [b"", b"\x00", b"\xff" * 50])
def test_foreign_bytes_are_refused(damage):
    with pytest.raises(ValueError, match=r"expected|damaged"):
        unpack(damage, np.dtype("int16"), (30,), "none", 0)
