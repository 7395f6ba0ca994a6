"""The faults of `mutations.py` can be planted: each text occurs exactly once in the code."""

from collections import Counter

import pytest

from tests.mutations import FAULTS, ROOT, importers


def test_there_are_enough_of_many_kinds():
    assert len(FAULTS) >= 40
    assert len({fault.kind for fault in FAULTS}) >= 8
    assert max(Counter((fault.module, fault.text) for fault in FAULTS).values()) == 1


@pytest.mark.parametrize("module", sorted({fault.module for fault in FAULTS}))
def test_every_text_occurs_once(module):
    faults = [fault for fault in FAULTS if fault.module == module]
    code = (ROOT / faults[0].path).read_text(encoding="utf-8")
    counts = {fault.text: code.count(fault.text) for fault in faults}
    assert {text: n for text, n in counts.items() if n != 1} == {}
    for fault in faults:
        assert fault.planted != fault.text
        compile(code.replace(fault.text, fault.planted), str(fault.path), "exec")
        assert all((ROOT / test).is_file() for test in fault.tests)


def test_kernels_of_all_that_import_a_module_are_compiled_anew():
    names = {path.as_posix() for path in importers("sphere/wigner")}
    assert {
        "reflfield/sphere/wigner.py",
        "reflfield/alignment/correlation.py",
        "reflfield/alignment/newton_ascent.py",
    } <= names
    assert "reflfield/sphere/rotations.py" not in names
