"""Tests JSON with one line for each list of numbers."""

import json

from hypothesis import given, settings
from hypothesis import strategies as st

from emberlink.trainers.runs.compact_json import dumps
from emberlink.trainers.runs.pretrained import find

plain = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()
values = st.recursive(
    plain, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4)
)


@settings(deadline=None)
@given(values)
def test_compact_json_parses_to_the_same_value(value):
    assert json.loads(dumps(value)) == value


def test_a_measure_takes_one_line():
    text = dumps(
        {"results": {"huygens": {"learned": {"coverage": [1.5] * 100, "exits": [2] * 100}}}}
    )
    assert [line.count(",") for line in text.splitlines()] == [0, 0, 0, 0, 100, 99, 0, 0, 0, 0]
    assert dumps({"a": [1, {"b": 2}]}) == '{"a": [1, {"b": 2}]}'


def test_shipped_evaluations_are_compact():
    for folder in find("pretrained:tuned"):
        text = (folder / "eval.json").read_text()
        assert text == dumps(json.loads(text)) + "\n"
        assert text.count("\n") < 300
