"""Modules shared by the tests of this folder."""

import importlib.util
from pathlib import Path

import pytest


def _module(name):
    path = Path(__file__).with_name(f"{name}.py")
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def scene():
    """The synthetic scene of the paper's section 5.1."""
    return _module("scene")


@pytest.fixture(scope="session")
def references():
    """Correlation by the paper's own sums."""
    return _module("references")
