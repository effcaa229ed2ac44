"""The player in a real browser.

It plays, scrubs, follows and draws, without an error and without a request.
"""

import json

import numpy as np
import pytest
from view_browser import browser_page
from view_scenes import straight

from ganlane.view import EpisodeLabel, write_player

CLOCK = "parseFloat(document.getElementById('time').textContent)"


def learned():
    """An episode with action values and rewards, as a trained agent leaves one."""
    time = np.arange(60) * 0.1
    values = 10.0 + np.stack([np.sin(time), np.cos(time), -time], axis=1)
    told = {
        "reward": np.sin(time),
        "action_values": values,
        "acceleration": np.sin(np.outer(time, [1.0, 2.0, 3.0])),
    }
    label = EpisodeLabel("agent </script><b>x", "idm", 3, 4)
    return straight([0, 25, -20], [1, 2, 0], 60, outcome="hard_crash", label=label, **told)


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    folder = tmp_path_factory.mktemp("player")
    path = write_player([straight([0, 40], [1, 2], 100), learned()], folder / "player.html")
    with browser_page(folder / "profile") as page:
        yield page, path


@pytest.fixture
def page(pages):
    opened, path = pages
    opened.open(path)
    yield opened
    assert opened.errors == []


def ink(page, selector, colour):
    """How many pixels of a canvas have (nearly) this colour."""
    script = """(() => {
        const canvas = document.querySelector(SELECTOR);
        const { width, height } = canvas;
        const data = canvas.getContext('2d').getImageData(0, 0, width, height).data;
        const near = (k) => COLOUR.every((value, i) => Math.abs(data[k + i] - value) <= 12);
        let count = 0;
        for (let k = 0; k < data.length; k += 4) if (near(k)) count++;
        return count;
    })()"""
    script = script.replace("SELECTOR", json.dumps(selector))
    return page.value(script.replace("COLOUR", json.dumps(colour)))


def scrub(page, time_s):
    page.value(
        f"(() => {{ const s = document.getElementById('scrub'); s.value = {time_s}; "
        "s.dispatchEvent(new Event('input')); })()"
    )


EGO = (255, 150, 28)
BLUE = (86, 160, 220)
ORANGE = (230, 120, 0)
GREEN = (47, 192, 143)
RED = (255, 62, 62)
FIRST, SECOND = ".episode:nth-child(1)", ".episode:nth-child(2)"


def test_the_page_shows_every_episode(page):
    assert page.value("document.querySelectorAll('.episode').length") == 2
    assert (
        page.value(f"document.querySelector('{SECOND} .title').textContent")
        == "agent </script><b>x on idm"
    )
    assert page.value("document.querySelectorAll('.title b').length") == 0
    for episode in (FIRST, SECOND):
        assert ink(page, f"{episode} .road", EGO) > 20


def test_play_goes_on_and_pause_stops(page):
    assert page.value(CLOCK) == 0.0
    page.click("#play")
    page.wait_for(f"{CLOCK} > 0.5")
    assert page.value("document.getElementById('play').textContent") == "Pause"
    page.click("#play")
    stopped = page.value(CLOCK)
    page.value("new Promise((done) => setTimeout(done, 200))")
    assert page.value(CLOCK) == stopped > 0.5


def test_scrubbing_sets_the_time_and_the_picture(page):
    before = ink(page, f"{SECOND} .road", RED)
    scrub(page, 5.9)
    assert page.value(CLOCK) == pytest.approx(5.9)
    assert "hard crash" in page.value(f"document.querySelector('{SECOND} .now').textContent")
    assert ink(page, f"{SECOND} .road", RED) > before + 50


def test_a_learned_agent_has_a_curve_per_action_and_others_have_none(page):
    assert page.value(f"document.querySelectorAll('{FIRST} [data-chart=q]').length") == 0
    assert page.value(f"document.querySelectorAll('{FIRST} [data-chart=reward]').length") == 0
    for colour in (BLUE, ORANGE, GREEN):
        assert ink(page, f"{SECOND} [data-chart=q]", colour) > 50
    for chart in ("reward", "acceleration", "jerk"):
        assert ink(page, f"{SECOND} [data-chart={chart}]", BLUE) > 50


def test_keys_step_and_play(page):
    page.key("ArrowRight", code="ArrowRight", windowsVirtualKeyCode=39)
    page.key("ArrowRight", code="ArrowRight", windowsVirtualKeyCode=39, modifiers=8)
    assert page.value(CLOCK) == pytest.approx(1.1)
    page.key("ArrowLeft", code="ArrowLeft", windowsVirtualKeyCode=37)
    assert page.value(CLOCK) == pytest.approx(1.0)
    page.key(" ", code="Space", windowsVirtualKeyCode=32)
    page.wait_for(f"{CLOCK} > 1.2")


def test_every_canvas_has_the_size_of_its_place_whatever_came_after_it(pages, tmp_path):
    opened, _ = pages
    opened.size(1920, 1080)
    opened.open(write_player([learned() for _ in range(6)], tmp_path / "six.html"))
    boxes = opened.value(
        "[...document.querySelectorAll('canvas')]"
        ".map((c) => [c.width, c.height, c.clientWidth, c.clientHeight])"
    )
    opened.value("document.getElementById('look').click()")
    opened.size(1200, 900)
    assert len(boxes) == 6 * 6
    assert [box for box in boxes if box[:2] != box[2:]] == []
    assert min(box[0] for box in boxes) > 500
