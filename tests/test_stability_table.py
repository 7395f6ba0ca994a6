"""The table of `-m stability`: rows, bounds that fail, and that every case has a test."""

from pathlib import Path

import numpy as np
import pytest

from tests.stability_table import CASES, STAGE_OF, Bounded, lines_of, missing_cases, rows_of

HERE = Path(__file__).parent
CASE = "any unit"


def records_of(*values, dtype=np.float32, bound=1.0, least=False):
    """Records of one bound, those that fail included."""
    properties = []
    state = Bounded(properties)
    for value in values:
        try:
            (state.at_least if least else state.at_most)(
                value, bound, case=CASE, quantity="error", source="a guess", dtype=dtype
            )
        except AssertionError:
            continue
    return [record for _, record in properties]


def test_both_precisions_share_a_row_with_the_worst_of_each():
    records = records_of(0.1, 0.9, 0.3) + records_of(1e-9, dtype=np.float64, bound=1e-8)
    (row,) = rows_of(records)
    assert (row["float32"], row["float64"]) == (0.9, 1e-9)
    assert row["bound"] == "<= 1 / 1e-08"
    assert (row["stage"], row["from"]) == ("completion", "a guess")
    text = "\n".join(lines_of([row]))
    assert "9.00e-01" in text
    assert text.splitlines()[0].startswith("case")


@pytest.mark.parametrize(
    ("values", "least", "worst"),
    [((0.5, 2.0, 1.0), False, 2.0), ((0.5, 2.0), True, 0.5), ((0.1, np.nan), False, np.nan)],
)
def test_the_observed_value_farthest_from_what_is_allowed_is_shown(values, least, worst):
    (row,) = rows_of(records_of(*values, least=least))
    np.testing.assert_equal(row["float32"], worst)


def test_a_bound_that_fails_is_recorded_and_fails_the_test():
    properties = []
    with pytest.raises(AssertionError, match=r"any unit: error is 2, allowed 1"):
        Bounded(properties).at_most(2.0, 1.0, case=CASE, quantity="error", source="a guess")
    with pytest.raises(AssertionError, match=r"error is 0.5, required 1"):
        Bounded(properties).at_least(0.5, 1.0, case=CASE, quantity="error", source="a guess")
    with pytest.raises(AssertionError):
        Bounded(properties).at_most(np.nan, 1.0, case=CASE, quantity="error", source="a guess")
    assert [record["observed"] for _, record in properties[:2]] == [2.0, 0.5]
    with pytest.raises(AssertionError, match="not among CASES"):
        Bounded([]).at_most(0.0, 1.0, case="no such", quantity="error", source="a guess")


def test_every_case_has_a_test_that_states_a_bound():
    texts = [path.read_text() for path in HERE.rglob("test_*.py") if path != Path(__file__)]
    code = "\n".join(texts)
    assert [case for case in STAGE_OF if f'"{case}"' not in code] == []
    assert len(STAGE_OF) == sum(map(len, CASES.values()))
    assert missing_cases([]) == list(STAGE_OF)
