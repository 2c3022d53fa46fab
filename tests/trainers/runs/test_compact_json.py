"""Tests JSON with one line for each list of numbers."""

import json
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emberlink.trainers.runs.compact_json import dumps, infinite

numbers = st.integers() | st.floats(allow_nan=False)
plain = st.none() | st.booleans() | numbers | st.text().filter(lambda t: t not in ("inf", "-inf"))
values = st.recursive(
    plain, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4)
)


@settings(deadline=None)
@given(values)
def test_compact_json_parses_to_the_same_value(value):
    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    assert infinite(json.loads(dumps(value), parse_constant=refuse)) == value


def test_numbers_that_json_lacks_are_texts():
    assert json.loads(dumps({"b": (-math.inf, 2)})) == {"b": ["-inf", 2]}
    assert '"a": [ 1, 2 ]\n' in dumps({"a": [1, 2]})
    with pytest.raises(ValueError, match="JSON compliant"):
        dumps({"a": [math.nan]})
