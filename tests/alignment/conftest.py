"""Modules shared by the tests of this folder."""

import importlib.util
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
BENCHMARKS = HERE.parent / "benchmarks"


def _module(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def scene():
    """The synthetic scene of the paper's section 5.1."""
    return _module(BENCHMARKS / "synthetic_btf.py")


@pytest.fixture(scope="session")
def references():
    """Correlation by the paper's own sums."""
    return _module(HERE / "references.py")


@pytest.fixture(scope="session")
def paper_forms():
    """The paper's sums on whole grids of rotations."""
    return _module(HERE / "paper_forms.py")
