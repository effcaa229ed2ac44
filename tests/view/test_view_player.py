"""The player's page holds the episodes, and nothing that could load or run anything else."""

import base64
import hashlib
import json
import re
from itertools import accumulate

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from view_scenes import straight

from ganlane.view import EpisodeLabel, player_page
from ganlane.view.player import episode_data, series, steps


def data_of(page):
    """The data in a page."""
    return json.loads(
        re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)[1]
    )


@settings(max_examples=30)
@given(
    st.lists(st.floats(-5000, 5000), min_size=1, max_size=50), st.sampled_from([0.01, 0.001, 0.1])
)
def test_a_series_is_exact_to_half_its_unit_however_long(values, unit):
    read = np.array(list(accumulate(series(np.array(values), unit)))) * unit
    assert np.abs(read - values).max() <= 0.5 * unit + 1e-9


def test_steps_are_the_changes_alone():
    assert steps(np.array([3, 3, 3, 1, 1, 2])) == [0, 3, 3, 1, 5, 2]
    assert steps(np.array([np.nan, np.nan, 0.333333])) == [0, None, 2, 0.33]
    assert steps(np.array([True, True, False])) == [0, 1, 2, 0]


def test_the_page_says_where_everybody_is():
    episode = straight([0, 30], [1, 2], frames=40)
    data = data_of(player_page([episode]))
    (shown,) = data["episodes"]
    assert (shown["agent"], shown["traffic"], shown["lanes"]) == ("mobil", "idm", 3)
    x = np.array(list(accumulate(shown["x"][1]))) * data["units"]["x"]
    assert x == pytest.approx(episode.x[:, 1], abs=0.006)
    assert shown["action_values"] == shown["reward"] == []


def test_reward_and_values_belong_to_the_decision_that_begins():
    reward = np.array([np.nan, 1.0, 1.0, 1.0, 5.0, 5.0])
    values = np.array([[np.nan], [7.0], [7.0], [7.0], [8.0], [8.0]])
    data = episode_data(straight([0], [1], frames=6, reward=reward, action_values=values))
    assert data["reward"] == [0, 1.0, 3, 5.0]
    assert data["action_values"] == [[0, 7.0, 3, 8.0]]


def test_comfort_is_of_the_ego():
    time = np.arange(30) * 0.1
    acceleration = np.stack([-2.0 * time, 9.0 * np.ones(30)], axis=1)
    episode = straight([0, 50], [1, 1], frames=30, acceleration=acceleration)
    comfort = episode_data(episode)["comfort"]
    assert comfort["hardest_braking"] == pytest.approx(-5.8)
    assert comfort["rms_acceleration"] == pytest.approx(np.sqrt(np.mean((2 * time) ** 2)), abs=1e-3)
    # 28 of 30 frames have a jerk of -2 m/s3.
    assert comfort["rms_jerk"] == pytest.approx(2.0 * np.sqrt(28 / 30), abs=1e-3)


@pytest.mark.parametrize(
    "name",
    [
        "</script><script>alert(1)</script>",
        "<!-- {{script}}",
        "a & b \"c\" 'd' \u2028",
        "<img src=x onerror=y>",
    ],
)
def test_a_name_cannot_become_part_of_the_page(name):
    plain = player_page([straight([0], [1])])
    page = player_page([straight([0], [1], label=EpisodeLabel(name, "{{style}}"))])
    (shown,) = data_of(page)["episodes"]
    assert (shown["agent"], shown["traffic"]) == (name, "{{style}}")
    for mark in ("<script", "</script", "<!--", "<img"):
        assert page.count(mark) == plain.count(mark), mark


def test_only_the_pages_own_scripts_may_run_and_nothing_may_be_loaded():
    page = player_page([straight([0], [1])])
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)[1]
    assert policy.startswith("default-src 'none'; ")
    for element, directive in (("style", "style-src"), ("script", "script-src")):
        text = re.search(rf"<{element}>(.*?)</{element}>", page, re.S)[1]
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{directive} 'sha256-{digest}'" in policy
    assert not re.search(r"https?://|src=|@import", page)
