"""The table of `pytest -m stability`: what is bounded in each hard case, and what was observed.

A test asks for the fixture `bounded` and states each bound with it; the statement is asserted
and becomes part of a row. Records travel as properties of the tests' reports, so that they come
from the workers of xdist as well.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

# Where the hard cases are listed: cases by the page that asks for them and the stage.
CASES = {
    ("alignment page", "alignment"): (
        "constant functions",
        "zero functions",
        "one observed sample",
        "rotational symmetry",
        "two-fold symmetry",
        "rotation exactly at beta = 0 or pi",
        "tilt past 60 degrees",
        "float32 against float64",
        "scale 1e-12 to 1e12",
        "one specular peak a million times the rest",
        "NaN and infinity where nothing was observed",
        "duplicates",
        "a single texel",
        "more clusters than texels",
        "correlation against the direct sum",
        "noise, and half the samples unobserved",
        "a maximum behind a saddle",
        "any functions",
        "any samples of texels",
    ),
    ("alignment page", "sphere"): (
        "Wigner d of degree 256",
        "any rotation, any degree",
        "any direction",
    ),
    ("factorization page", "completion"): (
        "gaps at random",
        "gaps shaped like occlusion",
        "smooth factors under occlusion",
        "rank above the true rank",
        "a column with nothing observed",
        "a row never observed",
        "columns under two percent observed",
        "values where nothing was observed",
        "orders of columns",
        "condition 1e12",
        "less and less observed",
        "channels that share their gaps",
        "any unit",
        "any small matrix",
    ),
    ("factorization page", "online SVD"): (
        "exactly low rank, ten thousand columns",
        "degenerate blocks",
        "any blocks",
    ),
    ("factorization page", "local PCA"): (
        "distances from an expanded square",
        "empty clusters",
        "degenerate columns",
        "any columns",
    ),
    ("fitting page", "fit"): (
        "grazing and opposite directions",
        "half vector at the zenith",
        "black and glaring pixels",
        "coefficients that would be negative",
        "texels without samples",
        "saturated pixels",
        "steps that are too long",
        "one light per view",
        "derivatives of pixels",
        "the normal matrix of pixels",
        "highlights without a long axis",
        "any samples",
    ),
    ("fitting page", "surface"): (
        "any unit of length",
        "texels at one point",
        "normals that nothing determines",
        "moves out of the hull",
        "any normals",
    ),
}
STAGE_OF = {case: (page, stage) for (page, stage), cases in CASES.items() for case in cases}
PROPERTY = "stability"
COLUMNS = ("case", "stage", "bounded", "bound", "from", "float32", "float64")
DTYPES = {"float32", "float64"}
MOST_NAMES = 8


class Bounded:
    """States bounds of one test, asserts them, and keeps them for the table."""

    def __init__(self, properties):
        self._properties = properties

    def at_most(self, observed, bound, *, case, quantity, source, dtype=np.float64, stage=None):
        """A value, or the largest of several, that must not exceed a bound.

        Parameters
        ----------
        observed, bound : float
        case : str
            One of `CASES`, or any other, with its stage.
        quantity : str
            What is bounded, with its unit.
        source : str
            Where the bound comes from.
        dtype : dtype
            In which the stage computes, float32 or float64.
        """
        value = float(np.max(observed))
        self._keep(value, bound, "<=", (case, stage, quantity, source, dtype))
        assert value <= bound, f"{case}: {quantity} is {value:.3g}, allowed {bound:.3g}"

    def at_least(
        self, observed, bound, *, case, quantity, source, dtype=np.float64, stage=None
    ):
        """As `at_most`, for what must not fall below a bound."""
        value = float(np.min(observed))
        self._keep(value, bound, ">=", (case, stage, quantity, source, dtype))
        assert value >= bound, f"{case}: {quantity} is {value:.3g}, required {bound:.3g}"

    def _keep(self, value, bound, sign, about):
        case, stage, quantity, source, dtype = about
        if stage is None:
            assert case in STAGE_OF, f"case {case!r}: not among CASES of {__name__}"
            stage = STAGE_OF[case][1]
        name = np.dtype(dtype).name
        assert name in DTYPES
        record = {
            "case": case,
            "stage": stage,
            "quantity": quantity,
            "source": source,
            "sign": sign,
            "bound": float(bound),
            "dtype": name,
            "observed": value,
        }
        self._properties.append((PROPERTY, record))


@pytest.fixture
def bounded(request):
    """`Bounded` of this test: states a bound, asserts it and records it for the table."""
    return Bounded(request.node.user_properties)


# --- the table ----------------------------------------------------------------------------


def worst(records):
    """Of records of one bound the one nearest to it, or farthest beyond; NaN first."""
    sign = 1 if records[0]["sign"] == "<=" else -1

    def excess(record):
        ratio = sign * record["observed"]
        return math.inf if math.isnan(ratio) else ratio

    return max(records, key=excess)


def rows_of(records):
    """Rows of the table: one for each case and quantity, float32 and float64 side by side."""
    groups = {}
    for record in records:
        key = tuple(record[name] for name in ("stage", "case", "quantity", "source", "sign"))
        groups.setdefault(key, {}).setdefault(record["dtype"], []).append(record)
    order = {case: place for place, case in enumerate(STAGE_OF)}
    rows = []
    for key in sorted(groups, key=lambda key: (order.get(key[1], len(order)), key)):
        stage, case, quantity, source, sign = key
        each = {dtype: worst(records) for dtype, records in sorted(groups[key].items())}
        bounds = list(dict.fromkeys(f"{one['bound']:.3g}" for one in each.values()))
        row = {"case": case, "stage": stage, "bounded": quantity}
        row |= {"bound": f"{sign} {' / '.join(bounds)}", "from": source}
        row |= {dtype: each[dtype]["observed"] if dtype in each else None for dtype in DTYPES}
        rows.append({name: row[name] for name in COLUMNS})
    return rows


def missing_cases(rows):
    """Cases of the pages that no row shows."""
    return [case for case in STAGE_OF if case not in {row["case"] for row in rows}]


def as_text(value):
    """A cell: figures with three digits, nothing where nothing was computed."""
    if value is None:
        return "-"
    return f"{value:.2e}" if isinstance(value, float) else str(value)


def lines_of(rows):
    """The table as lines of text, columns aligned."""
    cells = [COLUMNS, *(tuple(as_text(row[name]) for name in COLUMNS) for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for row in cells:
        yield "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))


class StabilityTable:
    """Collects the records of all tests, prints the table, and writes it."""

    def __init__(self, config):
        self.path = config.rootpath / config.getoption("--stability-table")
        self.selected = PROPERTY in (config.getoption("-m") or "")
        self.records, self.outcomes = [], {}

    def pytest_runtest_logreport(self, report):
        """Keep what a finished test has recorded."""
        if report.when == "call":
            self.records += [
                value for name, value in report.user_properties if name == PROPERTY
            ]
        if report.when == "call" or report.outcome != "passed":
            self.outcomes[report.nodeid] = report.outcome

    def pytest_terminal_summary(self, terminalreporter):
        """Print the table and say where it is."""
        if not (self.selected and self.records):
            return
        rows = rows_of(self.records)
        terminalreporter.section("stability")
        for line in lines_of(rows):
            terminalreporter.write_line(line)
        outcomes = list(self.outcomes.values())
        counts = ", ".join(f"{outcomes.count(o)} {o}" for o in sorted(set(outcomes)))
        terminalreporter.write_line(f"{len(rows)} bounds; tests of degenerate input: {counts}")
        if missing := missing_cases(rows):
            names = ", ".join(missing[:MOST_NAMES]) + ", ..." * (len(missing) > MOST_NAMES)
            terminalreporter.write_line(f"{len(missing)} cases without a figure: {names}")
        terminalreporter.write_line(f"written: {self.write(rows)}")

    def write(self, rows):
        """Write the table as the benchmarks write theirs, and return the path."""
        from tests.benchmarks.measuring import Results

        results = Results(self.path.stem, "Hard cases: what is bounded and observed", MODULES)
        results.table(
            "Worst of all tests of a bound; two bounds are those of the two precisions"
        )
        for row in rows:
            results.add(row)
        return results.write(self.path.parent, "python -m pytest -m stability")


MODULES = ("reflfield.alignment", "reflfield.factorization", "reflfield.fitting.image_fit")


def pytest_addoption(parser):
    parser.addoption(
        "--stability-table",
        metavar="FILE",
        default=".pytest_cache/stability.json",
        help="where `-m stability` writes its table; tests/benchmarks/results/stability.json "
        "is the one that RESULTS.md shows",
    )


def pytest_configure(config):
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(StabilityTable(config), "stability-table")
