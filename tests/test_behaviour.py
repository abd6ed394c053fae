"""Results of the commands against recorded ones: exit statuses, numbers, keys of the JSON and sentences.

`tests/data/behaviour.json` holds the recorded results. After an intended change, record them again with
`python -m tests.behaviour store`.
"""

import json

import pytest

from tests import behaviour

RECORDED = json.loads(behaviour.STORED.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def results() -> dict:
    return behaviour.record(quick=True)


def test_the_same_commands_were_recorded(results):
    assert results.keys() == RECORDED.keys()
    assert len([name for name, result in RECORDED.items() if result["code"] == 2]) >= 50


def test_users_get_what_was_recorded(results):
    differing = {
        name: lines
        for name, before in RECORDED.items()
        if (lines := behaviour.differences(before, results[name], estimates=True))
    }
    assert differing == {}


@pytest.mark.parametrize(
    ("before", "after", "count"),
    [
        ({"a": {"mean": 1.0, "sd": 0.1}}, {"a": {"mean": 1.0 + 9e-6, "sd": 0.1}}, 0),
        ({"a": {"mean": 1.0, "sd": 0.1}}, {"a": {"mean": 1.0 + 2e-5, "sd": 0.1}}, 1),
        ({"a": {"u": 0.06}}, {"a": {"u": 0.06 + 3e-7}}, 0),
        ({"a": {"u": 0.06}}, {"a": {"u": 0.06 + 5e-7}}, 1),
        ({"correlation": {"matrix": [-6.9e-9]}}, {"correlation": {"matrix": [-6.8e-9]}}, 0),
        ({"correlation": {"matrix": [0.5]}}, {"correlation": {"matrix": [0.500002]}}, 1),
        ({"said": ["± 5.1 % of 3"]}, {"said": ["± 5.2 % of 3"]}, 1),
        ({"said": ["no column"]}, {"said": ["no row"]}, 1),
        ({"a": 1, "b": 2}, {"a": 1}, 1),
        ({"compression_error": 2e-9}, {"compression_error": 3e-9}, 0),
    ],
)
def test_differences_are_seen(before, after, count):
    assert len(behaviour.differences(before, after, estimates=True)) == count
