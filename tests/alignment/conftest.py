"""Modules shared by the tests of this folder."""

import importlib.util
from pathlib import Path

import pytest

from reflfield.reproduction import paper_forms as forms
from reflfield.reproduction import paper_scene

HERE = Path(__file__).resolve().parent


def _module(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def scene():
    """The synthetic scene of the paper's section 5.1."""
    return paper_scene


@pytest.fixture(scope="session")
def references():
    """Correlation by the paper's own sums."""
    return _module(HERE / "references.py")


@pytest.fixture(scope="session")
def paper_forms():
    """The paper's sums on whole grids of rotations."""
    return forms
