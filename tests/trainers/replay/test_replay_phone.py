"""Tests replays on a phone, and of teams and maps of other sizes, in a browser."""

import pytest
from browser import Tab, chromium
from small_episode import STEPS, play_small

from emberlink.trainers.replay.pack import Shown
from emberlink.trainers.replay.page import Replay

pytestmark = pytest.mark.slow

DOTS = 3
PHONE = {
    "viewport": {"width": 390, "height": 844},
    "device_scale_factor": DOTS,
    "is_mobile": True,
    "has_touch": True,
}
MANY = 24
HOOKS = """() => {
    window.numbers = {};
    window.lines = new Set();
    const pen = CanvasRenderingContext2D.prototype, { fillText, stroke } = pen;
    pen.fillText = function (text, x, y) {
        window.numbers[text] = this.fillStyle;
        return fillText.call(this, text, x, y);
    };
    pen.stroke = function (...path) {
        if (!path.length) window.lines.add(`${this.strokeStyle} ${this.getLineDash()}`);
        return stroke.apply(this, path);
    };
}"""


@pytest.fixture(scope="module")
def browser():
    with chromium() as running:
        yield running


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "replay.html"
    episodes = {
        "random actions": play_small("env.num_uavs=6").recording,
        "a title of several lines " * 4: play_small().recording,
        "without messages": play_small("env.radio.range=0").recording,
    }
    shown = [Shown(title=title, recording=played) for title, played in episodes.items()]
    Replay(shown, "x:0").save(path)
    return path


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "large.html"
    played = play_small("env.grid=[100,100]", f"env.num_uavs={MANY}", "env.failures=0")
    Replay([Shown(title="many", recording=played.recording)], "x:0").save(path)
    return path


@pytest.fixture
def phone(browser, file):
    opened = Tab(browser, f"file://{file}", **PHONE)
    opened.page.wait_for_selector("#curves .uplot")
    yield opened
    opened.close()
    assert opened.problems == []


def step_of(tab) -> int:
    return int(tab.page.inner_text("#step"))


def picture(tab) -> str:
    return tab.page.locator("canvas.map").first.evaluate("map => map.toDataURL()")


def test_nothing_is_wider_than_the_phone(phone):
    page = phone.page
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    for control in ("first", "back", "play", "forth", "end", "slider", "speed", "heat", "uav"):
        page.locator(f"#{control}").scroll_into_view_if_needed()
        box = page.locator(f"#{control}").bounding_box()
        assert box["x"] >= 0, control
        assert box["x"] + box["width"] <= 390, control


def test_the_controls_stay_in_view_and_cover_what_is_behind_them(phone):
    box = phone.page.locator("#controls").bounding_box()
    assert (box["x"], box["width"]) == (0, 390)
    assert box["y"] + box["height"] == pytest.approx(844, abs=1)
    assert box["height"] < 844 / 6


def test_maps_have_the_dots_of_the_screen(phone):
    for canvas in phone.page.locator("canvas.map").all():
        wide = canvas.bounding_box()["width"]
        assert wide > 300
        assert canvas.evaluate("map => map.width") == round(wide * DOTS)


def test_the_slider_is_tapped_and_dragged(phone):
    box = phone.page.locator("#slider").bounding_box()
    middle = box["y"] + box["height"] / 2

    def place(share: float) -> dict[str, float]:
        return {"x": box["x"] + share * box["width"], "y": middle}

    phone.page.touchscreen.tap(*place(0.5).values())
    assert abs(step_of(phone) - STEPS / 2) <= 2
    finger = phone.page.context.new_cdp_session(phone.page)

    def touch(kind: str, *points: dict[str, float]) -> None:
        finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": list(points)})

    touch("touchStart", place(0.5))
    steps = []
    for share in (0.6, 0.7, 0.8, 0.9):
        touch("touchMove", place(share))
        steps.append(step_of(phone))
    touch("touchEnd")
    assert steps == sorted(set(steps))
    assert abs(step_of(phone) - 0.9 * STEPS) <= 4  # the thumb has a width
    assert phone.page.evaluate("scrollY") == 0


def test_buttons_layers_and_uavs_are_tapped(phone):
    page = phone.page
    page.tap("#forth")
    assert step_of(phone) == 1
    page.tap("#end")
    before = picture(phone)
    page.tap("label:has(#heat)")
    assert page.is_checked("#heat")
    assert picture(phone) != before
    page.tap("label:has(#heat)")
    assert picture(phone) == before
    page.tap("label:has([value=truth])")
    assert page.is_checked("[value=truth]")
    assert page.input_value("#uav") == "0"
    page.evaluate("scrollTo(0, 0)")
    x, y = uav_at(phone, 3)
    page.locator("canvas.map").first.tap(position={"x": x, "y": y})
    assert page.input_value("#uav") == "3"


def uav_at(tab, uav: int) -> tuple[float, float]:
    """Returns where a UAV of the first map is, from the numbers that the page shows of it."""
    page = tab.page
    page.select_option("#uav", str(uav))
    panel = page.locator(".panel").first
    x, y = (float(panel.locator(f"[data-number={name}]").inner_text()) for name in ("x", "y"))
    page.select_option("#uav", "0")
    scale = panel.locator("canvas").bounding_box()["width"] / 12
    return (x + 0.5) * scale, (10 - 0.5 - y) * scale


def test_maps_side_by_side_begin_at_the_same_height(browser, file):
    tab = Tab(browser, f"file://{file}")
    tab.page.wait_for_selector("#curves .uplot")
    boxes = [canvas.bounding_box() for canvas in tab.page.locator("canvas.map").all()]
    assert len({box["x"] for box in boxes}) == 3
    assert len({box["y"] for box in boxes}) == 1
    titles = [title.bounding_box() for title in tab.page.locator("figcaption:has(.title)").all()]
    assert len({title["height"] for title in titles}) > 1
    tab.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_uav_has_a_number_and_lines_of_its_own(scheme, browser, large):
    tab = Tab(browser, f"file://{large}", color_scheme=scheme, **PHONE)
    tab.page.wait_for_selector("#curves .uplot")
    tab.page.evaluate(HOOKS)
    for layer in ("outline", "views", "links"):
        tab.page.uncheck(f"#{layer}")
    tab.page.evaluate("lines.clear()")
    tab.page.evaluate("location.hash = '#t=30'")
    tab.wait_for(f"Object.keys(numbers).length === {MANY}")
    names = [f"--uav-{colour}" for colour in range(6)]
    style = "names => names.map(n => getComputedStyle(document.body).getPropertyValue(n).trim())"
    colours = tab.page.evaluate(style, names)
    lines = {line for line in tab.page.evaluate("[...lines]") if line.split()[0] in colours}
    assert len(lines) == MANY
    for uav, ink in tab.page.evaluate("numbers").items():
        assert contrast(ink, colours[int(uav) % 6]) > 3, uav
    assert tab.problems == []
    tab.close()


def contrast(one: str, other: str) -> float:
    """Returns the contrast of two colours as WCAG defines it, 1 to 21."""
    low, high = sorted(luminance(colour) for colour in (one, other))
    return (high + 0.05) / (low + 0.05)


def luminance(colour: str) -> float:
    parts = [int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)]
    linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return sum(w * p for w, p in zip((0.2126, 0.7152, 0.0722), linear, strict=True))
