"""Tests the contents of a replay: numbers, size, text and files."""

import json
import math
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
from refusal import refused
from small_episode import SIDES, STEPS, play_small
from test_render_command import make_run, rendered
from unpack_replay import data_of

from emberlink.envs import keys
from emberlink.trainers import load
from emberlink.trainers.cli import main
from emberlink.trainers.replay.page import Replay

HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>{{ 7*7 }}\"'&amp;"


@pytest.fixture(scope="module")
def episode():
    return play_small()


@pytest.fixture(scope="module")
def data(episode):
    return data_of(Replay([replace(episode.recording, title="one")], "small:0").html)


def test_numbers_of_every_step_are_those_of_the_environment(episode, data):
    (panel,) = data["panels"]
    assert episode.recording.steps["lost"].any()
    assert episode.known[-1][-1] > 0  # something reached the base
    whole = {"seen": keys.SEEN, "burning": keys.BURNING, "burnt": keys.BURNT}
    more = {"front_age": keys.FRONT_AGE, "base_seen": keys.BASE_SEEN, "base_age": keys.BASE_AGE}
    assert data["horizon"] == STEPS
    for step, now in enumerate(episode.steps):
        for name, key in {**whole, **more}.items():
            assert np.float32(panel[name][0][step]) == now[key].item(), (name, step)
        for uav in range(3):
            if step:
                assert np.float32(panel["reward"][uav][step]) == now[keys.REWARD][uav].item()
            for axis in range(3):
                shown = panel["position"][3 * uav + axis][step] / 100
                assert f"{shown:.2f}" == f"{now[keys.POSITION][uav, axis].item():.2f}"
            assert panel["follows"][uav][step] == now[keys.FOLLOWS][uav]
            for axis in range(2):
                target = panel["target"][2 * uav + axis][step] / 100
                assert target == pytest.approx(now[keys.TARGET][uav, axis].item(), abs=0.00501)
            assert (step < panel["fails"][uav]) == now[keys.ALIVE][uav].item()


@pytest.mark.parametrize("most", ["12", "null"])
def test_a_limited_radio_records_what_waits_and_the_links_of_those_that_speak(data, most):
    (plain,) = data["panels"]
    limits = f"env.radio.bandwidth={most}", "env.radio.delay=2", "env.radio.loss=0"
    limited = play_small(*limits, "env.reward.base=1")
    (panel,) = data_of(Replay([limited.recording], "").html)["panels"]
    assert not {"delay", "waits"} & {*plain}
    assert panel["delay"] == 2
    assert [[*row] for row in zip(*panel.get("waits", []), strict=True)] == limited.waits
    waiting = {n > 0 for row in limited.waits for n in row}
    assert waiting == ({True, False} if most == "12" else set())
    for step, now in enumerate(limited.steps):
        assert step == 0 or not now[keys.REWARD][~now[keys.ALIVE]].any()
        for source, sent in enumerate(now[keys.BYTES_SENT].tolist()):
            heard = [panel["hears"][4 * taker + source][step] == "1" for taker in range(3)]
            assert heard == (now[keys.HEARS][:, source] & (sent > 0)).tolist()


def _map(flat) -> list[list[int]]:
    return [flat[x * SIDES[1] : (x + 1) * SIDES[1]] for x in range(SIDES[0])]


def test_fields_of_view_are_those_of_the_camera(episode, data):
    (panel,) = data["panels"]
    slope = math.tan(math.radians(episode.config.env.view_angle))
    for step, now in enumerate(episode.steps):
        for uav, (x, y, z) in enumerate(now[keys.POSITION].double().tolist()):
            sees = step > 0 and now[keys.ALIVE][uav]
            left, right, low, high = (panel["view"][4 * uav + side][step] for side in range(4))
            for i in range(SIDES[0]):
                for j in range(SIDES[1]):
                    inside = abs(i - x) <= z * slope and abs(j - y) <= z * slope
                    assert (left <= i <= right and low <= j <= high) == (sees and inside)


def test_links_are_the_messages_received_and_the_others_in_range_are_lost(episode, data):
    (panel,) = data["panels"]
    for step, now in enumerate(episode.steps):
        places = [*now[keys.POSITION].double().tolist(), [3.0, 4.0, 0.0]]
        alive = [*now[keys.ALIVE].tolist(), True]
        for taker, here in enumerate(places):
            for source, there in enumerate(places):
                near = taker != source and math.dist(here, there) < 5
                near = near and alive[taker] and alive[source]
                heard, lost = (
                    panel[name][4 * taker + source][step] == "1" for name in ("hears", "lost")
                )
                assert heard + lost == near
                if max(taker, source) < 3:
                    assert heard == now[keys.HEARS][taker, source].item()


def test_fire_is_that_of_the_environment(episode, data):
    seen = episode.fire_map
    times = list(zip(_map(data["ignition"]), _map(data["end"]), strict=True))
    for step in range(STEPS + 1):
        for i, (ignition, end) in enumerate(times):
            state = [(step >= a) + (step >= b) for a, b in zip(ignition, end, strict=True)]
            assert state == [[0, 1, 1, 2, 2][cell] for cell in seen[step][i].tolist()]


def test_a_hostile_name_is_text(episode):
    page = Replay([replace(episode.recording, title=HOSTILE)], HOSTILE).html
    plain = Replay([replace(episode.recording, title="one")], "x:0").html
    assert data_of(page)["panels"][0]["title"] == HOSTILE
    assert _tags(page) == _tags(plain)
    frame = Replay([replace(episode.recording, title=HOSTILE)], HOSTILE)._repr_html_()
    assert [tag for tag, _ in _tags(frame)] == ["iframe"]


def _tags(page: str) -> list:
    """Returns the elements of a page with the names of their attributes."""
    found = []

    class Reader(HTMLParser):
        def handle_starttag(self, tag, attrs):
            found.append((tag, [name for name, _ in attrs]))

    Reader().feed(page)
    return found


def test_render_writes_a_page_of_several_runs(tmp_path, capsys):
    run = make_run(tmp_path)
    out = tmp_path / "replay.html"
    settings = ("env.radio.range=0", "--policy", "stationary", "--fire", "paper:3")
    assert rendered(capsys, run, run, *settings, "--output", out)[-1] == str(out)
    data = data_of(out.read_text())
    assert data["fire"] == "paper:3"
    assert [panel["title"] for panel in data["panels"]] == [
        *("consensus, setup tuned, seed 0", "consensus, setup tuned, seed 0, env.radio.range=0"),
        "stationary (scripted)",
    ]
    with_radio, without, _ = data["panels"]
    assert [row[0] for row in with_radio["position"]] == [row[0] for row in without["position"]]
    assert "1" in "".join(with_radio["hears"])
    assert "1" not in "".join(without["hears"])
    refused(["render", "env.radio.range=0", run], capsys, "after the run")


def test_the_last_numbers_are_those_of_the_evaluation(tmp_path):
    """The page in figures/ shows the first episode of eval.json, to the last bit."""
    run = make_run(tmp_path, "consensus", "evaluation.episodes=2", "evaluation.scripted=[]")
    assert main.main(["eval", str(run)]) == 0
    evaluated = json.loads((run / "eval.json").read_text())["results"]["huygens"]["learned"]
    (panel,) = data_of((run / "figures" / "replay.html").read_text())["panels"]
    covered = torch.tensor(100 * panel["seen"][0][-1]).float() / panel["burnt"][0][-1]
    assert covered.item() == pytest.approx(evaluated["coverage"][0], abs=0)
    rewards = np.array(panel["reward"])[:, 1:]
    assert rewards.mean() == pytest.approx(evaluated["mean_reward"][0], rel=1e-6)


def test_replay_from_python_equals_that_of_the_command(tmp_path, capsys):
    run = make_run(tmp_path)
    out = tmp_path / "replay.html"
    rendered(capsys, run, run, "env.radio.range=0.0", "--output", out)
    deaf = load(run, **{"env.radio.range": 0.0})
    shown = load(run).replay(deaf)
    assert shown.html == out.read_text()
    assert shown._repr_html_().startswith('<iframe srcdoc="&lt;!DOCTYPE html&gt;')
