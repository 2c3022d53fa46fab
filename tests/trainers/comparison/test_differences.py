"""Tests the difference between two methods of a comparison on numbers computed by hand."""

import json

import pytest
from synthetic_runs import read_evaluation, write_run

from emberlink.envs.utils.errors import UserError
from emberlink.trainers import compare
from emberlink.trainers.comparison.bootstrap import interval, iqm_difference

LOST = "consensus, evaluated with env.radio.loss=0.5"


@pytest.fixture(scope="module")
def section(tmp_path_factory):
    """Compares three seeds of consensus, also with lost messages, two of independent and one."""
    folder = tmp_path_factory.mktemp("runs")
    for seed, coverage in enumerate((50, 70, 63)):
        run = write_run(
            folder, "consensus", seed, learned={"coverage": [coverage - 5, coverage + 5] * 2}
        )
        content = read_evaluation(run) | {"environment": {"radio": {"loss": 0.5}}}
        (run / "eval_lost.json").write_text(json.dumps(content))
    for seed, coverage in enumerate((40, 66)):
        write_run(folder, "independent", seed, learned={"coverage": coverage})
    write_run(folder, "positional", learned={"coverage": 20})
    (section,) = compare([folder]).sections
    return section


def test_difference_by_hand(section):
    value, ends = section.difference("consensus", "independent", "coverage", "huygens")
    assert (value, ends) == (61 - 53, interval(iqm_difference, [50, 70, 63], [40, 66]))
    # Of the 108 differences of two resamples, the least is 50 - 66, once, and then 54 1/3 - 66,
    # three times. The greatest is 70 - 40, once, and then 67 2/3 - 40, three times.
    assert ends == pytest.approx((163 / 3 - 66, 203 / 3 - 40))


def test_the_other_way_round_a_difference_is_the_negative(tmp_path):
    methods = {"consensus": (1, 2, 4, 8, 16), "independent": (0, 3, 9, 27, 81)}
    for method, values in methods.items():
        for seed, coverage in enumerate(values):
            write_run(tmp_path, method, seed, learned={"coverage": coverage})
    (section,) = compare([tmp_path]).sections
    there = section.difference("independent", "consensus", "coverage", "huygens")
    back = section.difference("consensus", "independent", "coverage", "huygens")
    assert there.value == pytest.approx(13 - 14 / 3)
    assert there.interval == interval(iqm_difference, methods["independent"], methods["consensus"])
    assert there.interval is not None
    assert back == (-there.value, (-there.interval[1], -there.interval[0]))


def test_the_interval_of_a_difference_needs_two_seeds_of_both(section):
    assert section.difference(LOST, "positional", "coverage", "huygens") == (41, None)


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (("consensu", "positional", "coverage", "huygens"), "method 'consensu' is not known"),
        (("consensus", "other", "coverage", "huygens"), "known: consensus, .*independent, pos"),
        (("consensus", "positional", "cover", "huygens"), "measure 'cover' is not known.*coverage"),
        (("consensus", "positional", "coverage", "paper"), "fire 'paper' is not known.*huygens"),
        (("consensus", "positional", "mean_reward", "huygens"), "rewards differ"),
        (("consensus", LOST, "coverage", "huygens"), "are evaluations of the same runs"),
        (("consensus", "consensus", "coverage", "huygens"), "are evaluations of the same runs"),
    ],
)
def test_errors_of_a_difference(section, arguments, why):
    with pytest.raises(UserError, match=why):
        section.difference(*arguments)
