"""Ranges stand in the annotations of a record's fields, and are checked when one is made."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import pytest

from ganlane.errors import ParameterError
from ganlane.settings.record import DIFFERENT, Count, Positive, Range, Record, Share, between, one_of


@dataclass(frozen=True)
class Car(Record):
    length_m: Positive = 4.5
    doors: Annotated[int, between(2, 5)] = 4
    paint: Annotated[str, one_of(("red", "blue"))] = "red"
    tow_share: Share | None = None
    speed_mps: Range = (0.0, 30.0)
    wheels: Annotated[tuple[Count, ...], DIFFERENT] = (1, 2)


@dataclass(frozen=True)
class Van(Car):
    doors: int = 5


@dataclass
class Garage(Record):
    sizes: list[Count] = field(default_factory=lambda: [3])
    names: list[str] = field(default_factory=list)


@pytest.mark.parametrize(
    ("kind", "given", "told"),
    [
        (
            Car,
            {"length_m": 0.0},
            "length_m=0: expected a number above 0; give for instance length_m=4.5.",
        ),
        (Car, {"length_m": float("nan")}, "length_m=nan: expected a number above 0"),
        (Car, {"doors": 6}, "doors=6: expected a number from 2 to 5"),
        (Van, {"doors": 6}, "doors=6: expected a number from 2 to 5; give for instance doors=5."),
        (Car, {"paint": "rust"}, "paint=rust: expected one of red, blue"),
        (Car, {"tow_share": 1.5}, "tow_share=1.5: expected null or a number from 0 to 1."),
        (Car, {"speed_mps": [3, 2]}, "speed_mps=[3,2]: expected two numbers [low, high]"),
        (
            Car,
            {"wheels": [1, 0]},
            "wheels=[1,0]: expected a list, not empty, each entry at least 1",
        ),
        (Car, {"wheels": [1, 1]}, "wheels=[1,1]: expected a list of different entries"),
        (Garage, {"sizes": []}, "sizes=[]: expected a list, not empty"),
    ],
)
def test_a_value_out_of_its_range_is_refused(kind, given, told):
    with pytest.raises(ParameterError) as caught:
        kind(**given)
    assert str(caught.value).startswith(told)


def test_lists_become_tuples_where_the_field_is_one():
    assert Car(speed_mps=[1.0, 2.0], wheels=[3]) == Car(speed_mps=(1.0, 2.0), wheels=(3,))
    assert Garage(sizes=[1, 2]).sizes == [1, 2]
    assert replace(Car(), tow_share=0.5).tow_share == 0.5
