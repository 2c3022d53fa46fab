"""Tests the page that plays episodes in a browser, on a desktop and on a phone."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from browser import Tab, chromium
from small_episode import SIDES, STEPS, play_small

from emberlink.envs import WildfireConfig, keys
from emberlink.envs.config import RadioConfig
from emberlink.trainers.replay.page import Replay
from emberlink.trainers.replay.recording import Recording

pytestmark = pytest.mark.slow

HOSTILE = "</script><img src=x onerror=alert(1)><b>&lt;"
COLOURS = ("ground", "unknown", "fire", "unseen", "burnt", "missed")
LAYERS = ("outline", "views", "trails", "links", "lost", "roles", "failed", "heat")
VIEWS = ("truth", "team", "uav", "base")
PHONE = {
    "viewport": {"width": 400, "height": 844},
    "device_scale_factor": 3,
    "is_mobile": True,
    "has_touch": True,
}


@pytest.fixture(scope="module")
def browser():
    with chromium() as running:
        yield running


@pytest.fixture(scope="module")
def episodes():
    return [play_small("env.num_uavs=6"), play_small("env.num_uavs=6", "env.radio.range=0")]


@pytest.fixture(scope="module")
def replay(episodes):
    shown = [
        replace(episode.recording, title=title)
        for title, episode in zip(("with messages", HOSTILE), episodes, strict=True)
    ]
    return Replay(shown, HOSTILE)


@pytest.fixture(scope="module")
def file(replay, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "replay.html"
    replay.save(path)
    return path


@pytest.fixture(params=[{}, PHONE], ids=["desktop", "phone"])
def tab(request, browser, file):
    opened = Tab(browser, f"file://{file}", **request.param)
    opened.page.wait_for_selector("#curves .uplot")
    yield opened
    opened.close()
    assert opened.problems == []
    assert opened.requests == [f"file://{file}"]


def test_a_late_message_holds_what_was_known_when_it_was_sent(browser, tmp_path):
    """UAV 1 sees a fire at step 2, UAV 0 hears UAV 1 at step 4, UAV 2 UAV 0 from step 6 to 8."""
    steps, uavs = 13, 3
    ignition = np.full((8, 8), steps)
    ignition[5, 5] = 0
    values = {"position": np.ones((steps, uavs, 3), np.float32)}
    values |= {"alive": np.ones((steps, uavs), bool), "reward": values["position"][..., 0]}
    values |= {"view": np.tile([1, 0, 1, 0], (steps, uavs, 1))}
    values |= {name: np.zeros((steps, uavs, uavs), bool) for name in ("hears", "lost")}
    values |= {name: np.zeros(steps, int) for name in ("seen", "burning", "burnt")}
    values["waits"] = np.arange(steps * uavs).reshape(steps, uavs)
    values["view"][2, 1] = 5, 5, 5, 5
    for step, taker, source in ((4, 0, 1), (6, 2, 0), (7, 2, 0), (8, 2, 0)):
        values["hears"][step, taker, source] = True
    world = WildfireConfig(
        grid=(8, 8), num_uavs=uavs, horizon=steps - 1, radio=RadioConfig(delay=3, bandwidth=9)
    )
    end = np.full_like(ignition, steps)
    made = Recording(world=world, listens=True, ignition=ignition, end=end, steps=values)
    Replay([replace(made, title="late")], "").save(tmp_path / "page.html")
    tab = Tab(browser, f"file://{tmp_path / 'page.html'}")
    tab.page.wait_for_selector("#curves .uplot")
    assert "at most" in tab.page.inner_text("#layers")
    assert "in flight" in tab.page.inner_text("#legend")
    shown = {}
    for step in (*range(steps), 6):  # the last one backwards
        go_to(tab, step)
        for uav in range(uavs):
            tab.page.select_option("#uav", str(uav))
            numbers = [
                tab.page.inner_text(f"[data-number={name}]")
                for name in ("known", "flying", "waits")
            ]
            shown[step, uav] = [int(number) for number in numbers]
    known = {0: 4 + 3, 1: 2, 2: 8 + 3}
    sent = {0: (4,), 1: (), 2: (6, 7, 8)}
    for (step, uav), numbers in shown.items():
        flying = sum(0 <= step - then < 3 for then in sent[uav])
        assert numbers == [step >= known[uav], flying, 3 * step + uav]
    tab.close()


def step_of(tab) -> int:
    return int(tab.page.inner_text("#step"))


def go_to(tab, step: int) -> None:
    # At once: the page may be about to write its step into the address.
    tab.page.evaluate(
        f"history.replaceState(null, '', '#t={step}'); dispatchEvent(new Event('hashchange'))"
    )
    assert step_of(tab) == step


def text(value, digits: int) -> str:
    return f"{float(value):.{digits}f}".replace("-", "\u2212")


def share(seen, burnt) -> str:
    return text((100 * seen).float() / burnt if burnt else 100, 1)


def test_every_number_is_that_of_the_environment(tab, episodes):
    uav = 4
    script = """box => Object.fromEntries([...box.querySelectorAll('[data-number]')]
        .map(number => [number.dataset.number, number.textContent]))"""
    tab.page.select_option("#uav", str(uav))
    for step in (0, 17, STEPS):
        go_to(tab, step)
        for place, episode in enumerate(episodes):
            now = episode.steps[step]
            x, y, z = now[keys.POSITION][uav].tolist()
            expected = {
                "coverage": share(now[keys.SEEN], now[keys.BURNT]),
                "base_coverage": share(now[keys.BASE_SEEN], now[keys.BURNT]),
                **{name: text(now[name], 0) for name in ("seen", "burnt", "burning", "base_seen")},
                **{name: text(now[name], 2) for name in ("front_age", "base_age")},
                "known": text(episode.known[step][uav], 0),
                **{"x": text(x, 2), "y": text(y, 2), "z": text(z, 2)},
            }
            if step:
                expected["reward"] = text(now[keys.REWARD][uav].item(), 2)
            assert tab.page.locator(".panel").nth(place).evaluate(script) == expected
            for name in ("coverage", "front_age", "base_coverage"):
                values = tab.page.locator(f"[data-chart={name}] .u-value").all_inner_texts()
                assert values[0] == str(step)
                assert values[1 + place] == expected[name]


def test_it_plays_pauses_and_steps(tab):
    tab.page.select_option("#speed", "2")  # slow, so that a busy machine does not reach the end
    tab.page.click("#play")
    tab.wait_for("Number(document.getElementById('step').textContent) > 0")
    tab.page.click("#play")
    stopped = step_of(tab)
    tab.page.wait_for_timeout(600)
    assert step_of(tab) == stopped
    tab.wait_for(f"location.hash === '#t={stopped}'")
    for button, expected in (("first", 0), ("forth", 1), ("end", STEPS), ("back", STEPS - 1)):
        tab.page.click(f"#{button}")
        assert step_of(tab) == expected
    tab.page.fill("#slider", "12")
    assert step_of(tab) == 12
    tab.page.focus("#slider")
    for key, expected in (("ArrowRight", 13), ("ArrowLeft", 12), ("Home", 0), ("End", STEPS)):
        tab.page.keyboard.press(key)
        assert step_of(tab) == expected


def picture(tab, place: int = 0) -> str:
    return tab.page.locator("canvas.map").nth(place).evaluate("map => map.toDataURL()")


def test_every_layer_changes_the_map(tab, episodes):
    steps = episodes[0].recording.steps
    places = steps["position"][..., :2]
    apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1)
    lost = (steps["lost"][:, :6, :6] & (apart > 2)).any((1, 2))  # a line that UAVs do not hide
    chosen = np.flatnonzero(lost & ~steps["alive"].all(1))[0].item()
    go_to(tab, chosen)
    for layer in LAYERS:
        before = picture(tab)
        tab.page.click(f"#{layer}")
        assert picture(tab) != before, layer
        tab.page.click(f"#{layer}")
        assert picture(tab) == before, layer


def test_the_cells_of_a_map_are_those_of_the_environment(tab, episodes):
    style = "name => getComputedStyle(document.documentElement).getPropertyValue('--' + name)"
    values = {name: tab.page.evaluate(style, name).strip() for name in COLOURS}
    palette = {",".join(map(str, bytes.fromhex(v[1:]))): name for name, v in values.items()}
    tab.page.select_option("#uav", "2")
    for layer in ("outline", "views", "trails", "links", "roles", "failed"):
        tab.page.uncheck(f"#{layer}")
    for step in (STEPS, 5, 26):  # forwards and backwards
        go_to(tab, step)
        for view in VIEWS:
            tab.page.check(f"input[value={view}]")
            for place, episode in enumerate(episodes):
                shown, expected = cells(tab, place, palette), expected_cells(episode, view, step)
                pairs = [(shown[x][y], expected[x][y]) for x in range(12) for y in range(10)]
                assert all(one in ("mark", other) for one, other in pairs), (view, step)
                assert sum(one != "mark" for one, _ in pairs) > 100


def cells(tab, place: int, palette: dict) -> list[list[str]]:
    """Returns the colour of each cell at its middle, by the name in the style: [X][Y]."""
    script = """(map, [columns, rows]) => {
        const copy = new OffscreenCanvas(map.width, map.height), side = map.width / columns;
        const pen = copy.getContext('2d', {willReadFrequently: true});
        pen.drawImage(map, 0, 0);
        return Array.from({length: columns}, (_, x) => Array.from({length: rows}, (_, y) => {
            const at = [(x + 0.5) * side, (rows - 0.5 - y) * side].map(Math.floor);
            return [...pen.getImageData(...at, 1, 1).data].slice(0, 3).join();
        }));
    }"""
    found = tab.page.locator("canvas.map").nth(place).evaluate(script, list(SIDES))
    return [[palette.get(colour, "mark") for colour in column] for column in found]


def expected_cells(episode, view: str, step: int) -> list[list[str]]:
    fire, names = episode.fire_map[step], ("ground", "fire", "unseen", "burnt", "missed")
    if view == "truth":
        return [
            [("ground", "fire", "fire", "burnt", "burnt")[cell] for cell in row]
            for row in fire.tolist()
        ]
    known = episode.knowledge[step]
    if view == "team":
        looked = known[:6].amax(0) >= 0
        return [
            [
                "unknown" if not cell and not seen else names[cell]
                for cell, seen in zip(row, line, strict=True)
            ]
            for row, line in zip(fire.tolist(), looked.tolist(), strict=True)
        ]
    last = known[{"uav": 2, "base": 6}[view]]
    burning = (episode.arrival <= last) & (last < episode.burn_out)
    state = torch.where(burning, 1, torch.where(episode.burn_out <= last, 3, 0))
    return [
        ["unknown" if seen < 0 else names[cell] for cell, seen in zip(row, line, strict=True)]
        for row, line in zip(state.tolist(), last.tolist(), strict=True)
    ]


@pytest.mark.parametrize("whole", [True, False])
def test_a_damaged_page_gives_a_message(whole, browser, replay, tmp_path):
    (packed,) = re.findall(r'id="data">([^<]*)<', replay.html)
    middle = len(packed) // 2
    letter = "A" if packed[middle] != "A" else "B"
    damaged = packed[:middle] + (letter + packed[middle + 1 :] if whole else "")
    (tmp_path / "page.html").write_text(replay.html.replace(packed, damaged))
    tab = Tab(browser, f"file://{tmp_path / 'page.html'}")
    tab.wait_for("getComputedStyle(document.getElementById('message')).visibility === 'visible'")
    tab.wait_for("!document.getElementById('message').hidden")
    assert "damaged" in tab.page.inner_text("#message")
    assert not tab.page.is_visible("#page")
    tab.close()
