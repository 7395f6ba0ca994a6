"""Fixtures that every test may use."""

from __future__ import annotations

import os
from pathlib import Path

import distributed
import numpy as np
import pytest

SEED = 20060905  # one seed for all; change it with --seed


def pytest_addoption(parser):
    parser.addoption("--slow", action="store_true", help="run the tests that take minutes")
    parser.addoption("--seed", type=int, default=SEED, help="seed of the `rng` fixture")


def pytest_collection_modifyitems(config, items):
    if config.getoption("--slow"):
        return
    skip = pytest.mark.skip(reason="takes minutes; run with --slow")
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(skip)


@pytest.fixture
def rng(request):
    return np.random.default_rng(request.config.getoption("--seed"))


@pytest.fixture
def rounding():
    """Tolerance = safety * eps(dtype) * operations * condition * scale."""

    def tolerance(dtype, operations=1.0, condition=1.0, scale=1.0, safety=8.0):
        return float(safety * np.finfo(dtype).eps * operations * condition * scale)

    return tolerance


@pytest.fixture(scope="session")
def cluster():
    """Address of a dask cluster of two worker processes."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as local:
        yield local.scheduler_address


@pytest.fixture(scope="session")
def shared_data():
    """Return a function from the name of a test set to its folder; skips where it is absent."""
    here = Path(__file__).resolve().parents[2] / "shared" / "data"
    root = Path(os.environ.get("REFLFIELD_DATA", here))

    def folder(name):
        path = root / name
        if not path.exists():
            pytest.skip(f"test data {name!r} not found under {root} (set REFLFIELD_DATA)")
        return path

    return folder
