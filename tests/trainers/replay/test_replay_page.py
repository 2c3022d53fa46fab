"""Tests a replay in a browser."""

import base64
import dataclasses
import gzip
import html
import json
import re

import pytest
import torch
from browser import Tab, chromium
from small_episode import SIDES, STEPS, play_small

from emberlink.envs import keys
from emberlink.trainers.replay.pack import Shown
from emberlink.trainers.replay.page import Replay

pytestmark = pytest.mark.slow

HOSTILE = "</script><img src=x onerror=alert(1)><b>&lt;"
SIX = ("env.num_uavs=6",)
COLOURS = ("ground", "unknown", "fire", "unseen", "burnt", "missed")


@pytest.fixture(scope="module")
def browser():
    with chromium() as running:
        yield running


@pytest.fixture(scope="module")
def episodes():
    return [play_small(*SIX), play_small(*SIX, "env.radio.range=0")]


@pytest.fixture(scope="module")
def replay(episodes):
    titles = ("with messages", f"without {HOSTILE}")
    shown = [Shown(title=t, recording=e.recording) for t, e in zip(titles, episodes, strict=True)]
    return Replay(shown, HOSTILE)


@pytest.fixture(scope="module")
def file(replay, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "replay.html"
    replay.save(path)
    return path


@pytest.fixture
def tab(browser, file):
    opened = Tab(browser, f"file://{file}")
    opened.page.wait_for_selector("#curves .uplot")
    yield opened
    opened.close()
    assert opened.problems == []
    assert opened.requests == [f"file://{file}"]


def step_of(tab) -> int:
    return int(tab.page.inner_text("#step"))


def go_to(tab, step: int) -> None:
    # At once: the page may be about to write its step into the address.
    tab.page.evaluate(
        f"history.replaceState(null, '', '#t={step}'); dispatchEvent(new Event('hashchange'))"
    )
    assert step_of(tab) == step


def shown_numbers(tab, place: int) -> dict[str, str]:
    script = """box => Object.fromEntries([...box.querySelectorAll('[data-number]')]
        .map(number => [number.dataset.number, number.textContent]))"""
    return tab.page.locator(".panel").nth(place).evaluate(script)


def text(value, digits: int) -> str:
    return f"{float(value):.{digits}f}".replace("-", "\u2212")


def share(seen, burnt) -> str:
    return text((100 * seen).float() / burnt if burnt else 100, 1)


@pytest.mark.parametrize("uav", [0, 4])
def test_every_number_is_that_of_the_environment(tab, episodes, uav):
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
                "front_age_p95": text(now[keys.FRONT_AGE_P95], 0),
                "known": text(episode.known[step][uav], 0),
                **{"x": text(x, 2), "y": text(y, 2), "z": text(z, 2)},
            }
            if step:
                expected["reward"] = text(now[keys.REWARD][uav].item(), 2)
            assert shown_numbers(tab, place) == expected
            _check_curves(tab, place, step, now, expected)


def _check_curves(tab, place, step, now, expected) -> None:
    """Checks the numbers beside the curves, which are those at the cursor."""
    for name in ("coverage", "front_age", "base_coverage"):
        values = tab.page.locator(f"[data-chart={name}] .u-value").all_inner_texts()
        assert values[0] == str(step)
        assert values[1 + place] == expected[name]
    rows = tab.page.locator(f"[data-chart=reward-{place}] .u-series:not([hidden])")
    rewards = dict(row.replace(":", "").rsplit(maxsplit=1) for row in rows.all_inner_texts()[1:])
    for uav, reward in enumerate(now.get(keys.REWARD, torch.full((6, 1), torch.nan)).tolist()):
        assert rewards[f"UAV {uav}"] == (text(reward[0], 2) if step else "\u2013")


def test_it_plays_pauses_and_steps(tab):
    assert step_of(tab) == 0
    tab.page.select_option("#speed", "2")  # slow, so that a busy machine does not reach the end
    tab.page.click("#play")
    assert tab.page.get_attribute("#play", "aria-label") == "Pause"
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
        tab.wait_for(f"location.hash === '#t={expected}'")
    tab.page.select_option("#speed", "60")
    tab.page.locator("h1").click()
    tab.page.keyboard.press("Space")  # at the end it begins again
    tab.wait_for(f"Number(document.getElementById('step').textContent) < {STEPS}")
    tab.wait_for("document.getElementById('play').ariaLabel === 'Play'")
    assert step_of(tab) == STEPS


def test_the_address_and_a_click_on_a_curve_choose_the_step(browser, file):
    tab = Tab(browser, f"file://{file}#t=23")
    tab.page.wait_for_selector("#curves .uplot")
    assert step_of(tab) == 23
    tab.page.locator("[data-chart=coverage] .u-over").click()  # in the middle
    assert step_of(tab) == STEPS // 2
    go_to(tab, 7)
    tab.wait_for("location.hash === '#t=7'")
    tab.page.evaluate("location.hash = '#t=999999'")
    tab.wait_for(f"document.getElementById('step').textContent === '{STEPS}'")
    assert tab.problems == []
    tab.close()


LAYERS = ("outline", "views", "trails", "links", "lost", "roles", "failed", "heat")
VIEWS = ("truth", "team", "uav", "base")


def picture(tab, place: int = 0) -> str:
    return tab.page.locator("canvas.map").nth(place).evaluate("map => map.toDataURL()")


def choose(tab, view: str) -> None:
    tab.page.check(f"input[value={view}]")


def test_every_layer_changes_the_map(tab, episodes):
    steps = episodes[0].recording.steps
    chosen = next(
        step
        for step in range(10, STEPS)
        if steps["lost"][step, :6, :6].any() and not steps["alive"][step].all()
    )
    go_to(tab, chosen)
    for layer in LAYERS:
        before = picture(tab)
        tab.page.click(f"#{layer}")
        assert picture(tab) != before, layer
        tab.page.click(f"#{layer}")
        assert picture(tab) == before, layer
    go_to(tab, STEPS)
    least = episodes[0].known[STEPS].argmin()  # a UAV that knows less than the base
    tab.page.select_option("#uav", str(least.item()))
    pictures = set()
    for view in VIEWS:
        choose(tab, view)
        pictures.add(picture(tab))
    assert len(pictures) == len(VIEWS)
    choose(tab, "uav")
    before = picture(tab)
    tab.page.select_option("#uav", str(episodes[0].known[STEPS][:6].argmax().item()))
    assert picture(tab) != before


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


def styles(tab) -> dict[str, str]:
    """Returns the name of each colour of cells."""
    script = (
        "name => getComputedStyle(document.documentElement).getPropertyValue('--' + name).trim()"
    )
    values = {name: tab.page.evaluate(script, name) for name in COLOURS}
    return {",".join(str(b) for b in bytes.fromhex(v[1:])): name for name, v in values.items()}


def test_the_cells_of_a_map_are_those_of_the_environment(tab, episodes):
    palette = styles(tab)
    tab.page.select_option("#uav", "2")
    for layer in ("outline", "views", "trails", "links", "roles", "failed"):
        tab.page.uncheck(f"#{layer}")
    for step in (STEPS, 5, 26):  # forwards and backwards
        go_to(tab, step)
        for view in VIEWS:
            choose(tab, view)
            for place, episode in enumerate(episodes):
                shown, expected = cells(tab, place, palette), expected_cells(episode, view, step)
                pairs = [(shown[x][y], expected[x][y]) for x in range(12) for y in range(10)]
                assert all(one in ("mark", other) for one, other in pairs), (view, step)
                assert sum(one != "mark" for one, _ in pairs) > 100


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


def test_hostile_names_are_text(tab):
    assert HOSTILE in tab.page.inner_text("h1")
    assert tab.page.title() == f"Replay: {HOSTILE}"
    assert tab.page.locator(".panel .title").nth(1).inner_text() == f"without {HOSTILE}"
    assert tab.page.locator("img").count() == 0
    assert tab.page.locator("h1 b, .title b, .u-label b, figcaption b").count() == 0


def test_dark_pages_have_other_colours(browser, file):
    found = []
    for scheme in ("light", "dark"):
        tab = Tab(browser, f"file://{file}#t=20", color_scheme=scheme)
        tab.page.wait_for_selector("#curves .uplot")
        paper = tab.page.evaluate("getComputedStyle(document.body).backgroundColor")
        found.append((paper, picture(tab)))
        if scheme == "light":
            tab.page.emulate_media(color_scheme="dark")
            tab.page.wait_for_timeout(100)
            changed = picture(tab)
        tab.close()
    assert found[0][0] == "rgb(255, 255, 255)"
    assert found[0][0] != found[1][0]
    assert found[0][1] != found[1][1] == changed


@pytest.mark.parametrize("change", ["uav", "colours"])
def test_the_curves_are_drawn_anew_at_the_step(tab, change):
    tab.page.set_viewport_size({"width": 1200, "height": 900})
    go_to(tab, 17)
    if change == "uav":
        tab.page.select_option("#uav", "3")
    else:
        tab.page.emulate_media(color_scheme="dark")
    tab.page.wait_for_timeout(100)
    found = tab.page.locator("#curves figure").evaluate_all(
        """boxes => boxes.map(box => [
            box.querySelector('.u-value').textContent,
            box.querySelector('.uplot').offsetWidth - box.clientWidth,
            box.querySelector('.u-cursor-x').style.transform])"""
    )
    assert len(found) > 3
    assert {(step, wider) for step, wider, _ in found} == {("17", 0)}
    assert all(re.match(r"translate\([1-9]", place) for _, _, place in found)


def test_a_page_whose_program_is_damaged_gives_a_message(browser, replay, tmp_path):
    (tmp_path / "page.html").write_text(replay.html.replace("new uPlot(", "new uPl0t("))
    tab = Tab(browser, f"file://{tmp_path / 'page.html'}")
    tab.page.wait_for_selector("#message:not(.late)")
    assert "damaged" in tab.page.inner_text("#message")
    assert not tab.page.is_visible("#page")
    tab.close()


def test_controls_have_names_for_screen_readers(tab):
    unnamed = tab.page.evaluate(
        """[...document.querySelectorAll('button, input, select, canvas.map')].filter(control =>
            !control.getAttribute('aria-label') && !control.closest('label')).length"""
    )
    assert unnamed == 0
    tab.page.keyboard.press("End")
    assert tab.page.inner_text("#said").startswith(f"Step {STEPS}. with messages: coverage ")
    label = tab.page.locator("canvas.map").first.get_attribute("aria-label")
    assert label.startswith(f"Map at step {STEPS}. with messages: coverage ")


def damages(packed: str):
    """Yields damaged versions of a text in base64."""
    middle = len(packed) // 2
    other = "A" if packed[middle] != "A" else "B"
    yield packed[:middle] + other + packed[middle + 1 :]
    yield packed[:middle]
    yield packed[:middle] + "!" + packed[middle + 1 :]
    yield packed + "AAAA"
    yield ""


def test_damaged_data_give_a_message(browser, replay, tmp_path):
    (packed,) = re.findall(r'id="data">([^<]*)<', replay.html)
    for place, damaged in enumerate(damages(packed)):
        path = tmp_path / f"{place}.html"
        path.write_text(replay.html.replace(packed, damaged))
        tab = Tab(browser, f"file://{path}")
        tab.page.wait_for_selector("#message:not(.late)")
        said = tab.page.inner_text("#message")
        assert "damaged" in said
        assert "!" not in damaged or said.endswith("(not in base64).")
        assert not tab.page.is_visible("#page")
        assert tab.problems == []
        tab.close()


def test_a_file_without_its_end_gives_a_message(browser, replay, tmp_path):
    for share in (0.5, 0.9, 0.97):
        path = tmp_path / f"{share}.html"
        path.write_text(replay.html[: int(len(replay.html) * share)])
        tab = Tab(browser, f"file://{path}")
        tab.wait_for(
            "getComputedStyle(document.getElementById('message')).visibility === 'visible'"
        )
        assert "damaged" in tab.page.inner_text("#message")
        assert not tab.page.is_visible("#page")
        tab.close()


def repacked(replay, change) -> str:
    """Returns the page with another header, and a checksum that fits."""
    (packed,) = re.findall(r'id="data">([^<]*)<', replay.html)
    content = gzip.decompress(base64.b64decode(packed))
    length = int.from_bytes(content[:4], "little")
    header = json.loads(content[4 : 4 + length])
    change(header)
    text = json.dumps(header).encode()
    text += b" " * (-(len(text) + 4) % 8)
    data = gzip.compress(len(text).to_bytes(4, "little") + text + content[4 + length :])
    return replay.html.replace(packed, base64.b64encode(data).decode())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda header: header["panels"].clear(), "no episode"),
        (lambda header: header["panels"][0].pop("position"), "position is missing"),
        (lambda header: header.update(horizon=2000), "steps of 2001"),
    ],
)
def test_data_that_do_not_fit_give_a_message(change, message, browser, replay, tmp_path):
    path = tmp_path / "page.html"
    path.write_text(repacked(replay, change))
    tab = Tab(browser, f"file://{path}")
    tab.page.wait_for_selector("#message:not(.late)")
    assert message in tab.page.inner_text("#message")
    assert not tab.page.is_visible("#page")
    assert tab.problems == []
    tab.close()


def test_jupyter_shows_the_page_inline(browser, replay, tmp_path):
    notebook = tmp_path / "notebook.html"
    notebook.write_text(f"<title>{html.escape('a notebook')}</title>{replay._repr_html_()}")
    tab = Tab(browser, f"file://{notebook}", viewport={"width": 1000, "height": 900})
    frame = tab.page.frame_locator("iframe")
    frame.locator("#curves .uplot").first.wait_for()
    frame.locator("#forth").click()
    assert frame.locator("#step").inner_text() == "1"
    assert tab.page.url == f"file://{notebook}"
    assert tab.problems == []
    tab.close()


def test_one_uav_and_one_step_can_be_shown(browser, tmp_path):
    whole = play_small("env.num_uavs=1", "env.base=null", "env.failures=0").recording
    steps = {name: values[:2] for name, values in whole.steps.items()}
    short = dataclasses.replace(whole, steps=steps, end=whole.end.clip(max=2))
    path = tmp_path / "short.html"
    Replay([Shown(title="short", recording=short)], "x:0").save(path)
    tab = Tab(browser, f"file://{path}")
    tab.page.wait_for_selector("#curves .uplot")
    tab.page.keyboard.press("End")
    assert step_of(tab) == 1
    assert not tab.page.is_visible("#base")
    assert tab.problems == []
    tab.close()
