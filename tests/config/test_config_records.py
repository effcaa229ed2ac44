"""A record's constructor takes plain data, and says in one sentence what is wrong with it."""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.refusals import user_error

from ganlane.errors import ParameterError, UserError
from ganlane.settings.agent import RainbowConfig
from ganlane.settings.env import EnvConfig
from ganlane.settings.episode import EpisodeParameters
from ganlane.settings.record import (
    DIFFERENT,
    NO_KEY,
    Count,
    Positive,
    Range,
    Record,
    Share,
    between,
    make,
    merged,
    one_of,
    plain,
)


@dataclass(frozen=True)
class Engine(Record):
    power_kw: Positive = 80.0
    fuel: str = "petrol"


@dataclass(frozen=True)
class Car(Record):
    length_m: Positive = 4.5
    doors: Annotated[int, between(2, 5)] = 4
    paint: Annotated[str, one_of(("red", "blue"))] = "red"
    tow_share: Share | None = None
    speed_mps: Range = (0.0, 30.0)
    wheels: Annotated[tuple[Count, ...], DIFFERENT] = (1, 2)
    names: list[str] = field(default_factory=list)
    seats: dict[str, Count] = field(default_factory=dict)
    electric: bool = False
    engine: Engine = field(default_factory=Engine)
    hidden: int = field(default=0, metadata=NO_KEY)


@pytest.mark.parametrize(
    ("values", "told"),
    [
        (
            {"length_m": 0.0},
            "length_m=0: expected a number above 0; give for instance length_m=4.5.",
        ),
        ({"length_m": float("nan")}, "length_m=nan: expected a number above 0"),
        ({"length_m": "long"}, "length_m=long: expected a number; give"),
        ({"length_m": 10**400}, "length_m=1000"),
        ({"length_m": None}, "length_m=null: expected a number"),
        ({"doors": 6}, "doors=6: expected a number from 2 to 5"),
        ({"doors": 2.5}, "doors=2.5: expected a whole number"),
        ({"doors": True}, "doors=true: expected a whole number"),
        ({"paint": "rust"}, "paint=rust: expected one of red, blue"),
        ({"tow_share": 1.5}, "tow_share=1.5: expected a number from 0 to 1."),
        ({"speed_mps": [3, 2]}, "speed_mps=[3,2]: expected two numbers [low, high]"),
        ({"speed_mps": [3]}, "speed_mps=[3]: expected 2 entries"),
        ({"speed_mps": 3}, "speed_mps=3: expected a list in brackets"),
        ({"wheels": [1, 0]}, "wheels=0: expected at least 1"),
        ({"wheels": [1, 1]}, "wheels=[1,1]: expected a list of different entries"),
        ({"names": ["\x1b[31mred"]}, r"names=\x1b[31mred: expected a text without control"),
        ({"seats": 3}, "seats=3: expected names with values, {name: value}"),
        ({"seats": {"front": 0}}, "seats.front=0: expected at least 1"),
        ({"electric": "perhaps"}, "electric=perhaps: expected true or false"),
        ({"engine": 3}, "engine=3: it has keys of its own; give engine.NAME=VALUE."),
        ({"engine": {"power_kw": -1}}, "engine.power_kw=-1: expected a number above 0"),
        ({"engine": {"pwer_kw": 1}}, "engine.pwer_kw: no such key (did you mean 'power_kw'?)"),
        ({"dors": 4}, "dors: no such key (did you mean 'doors'?); known are doors,"),
        ({"hidden": 4}, "hidden: no such key"),
    ],
)
def test_a_value_that_will_not_do_is_told_in_one_sentence(values, told):
    with pytest.raises(ParameterError) as caught:
        make(Car, values)
    assert str(caught.value).startswith(told)


@settings(max_examples=40)
@given(
    st.dictionaries(
        st.sampled_from(["doors", "length_m", "paint", "wheels", "engine", "seats", "names"]),
        st.recursive(
            st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
            lambda inner: (
                st.lists(inner, max_size=3)
                | st.dictionaries(st.text(max_size=3), inner, max_size=2)
            ),
            max_leaves=5,
        ),
    )
)
def test_any_plain_data_make_a_record_or_a_users_error(values):
    try:
        car = make(Car, values)
    except UserError:
        return
    assert make(Car, plain(car)) == car


def test_numbers_of_numpy_and_torch_paths_and_whole_floats_are_taken():
    car = Car(
        length_m=np.float32(5),
        doors=2e0,
        wheels=torch.tensor([3, 4]),
        names=[Path("a/b"), 7],
        electric=np.bool_(True),
    )
    assert (car.length_m, car.doors, car.wheels) == (5.0, 2, (3, 4))
    assert (car.names, car.electric) == (["a/b", "7"], True)
    assert type(car.doors) is int


def test_an_option_is_its_name_or_a_mapping_with_changes():
    plainly = make(RainbowConfig, "dqn")
    assert not any((plainly.noisy, plainly.dueling, plainly.double))
    assert make(RainbowConfig, {"name": "dqn", "gamma": 0.9}) == replace(plainly, gamma=0.9)
    with user_error(r"agent=dqm: no such option \(did you mean 'dqn'\?\)"):
        make(RainbowConfig, "dqm")


def test_a_mapping_with_a_name_replaces_and_one_without_changes():
    below: dict[str, Any] = {"traffic": {"name": "gan", "guard": False}, "env": {"lanes": 3}}
    above = {"traffic": {"name": "idm"}, "env": {"vehicles": 5}}
    assert merged(below, above) == {"traffic": {"name": "idm"}, "env": {"lanes": 3, "vehicles": 5}}


@pytest.mark.parametrize("scene", ["cut_in", "stalled_car", "blocked_lane", "stop_and_go", "dense"])
def test_a_record_is_made_again_from_its_plain_data(scene):
    env = make(EnvConfig, scene)
    assert make(EnvConfig, plain(env)) == env


def test_an_episode_ends_where_float32_still_counts():
    for told, values in (
        ("timeout_s=1e+18: expected a number above 0, at most 1000000, ", {"timeout_s": 1e18}),
        ("goal_m=100001: expected a number above 0, at most 100000, ", {"goal_m": 100_001.0}),
    ):
        with user_error(re.escape(told)):
            EpisodeParameters(**values)
    assert EpisodeParameters(timeout_s=1e6, goal_m=1e5).most_decisions() == 1_000_000
