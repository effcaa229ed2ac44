"""The schema's validator on frames that do not come from a file."""

import polars as pl
import pytest

from ganlane.data import SyntheticTraffic, synthetic_scenes, validate
from ganlane.errors import UserError


def test_the_validator_checks_frames_that_come_from_nowhere():
    made = synthetic_scenes(SyntheticTraffic(scenes=1))
    assert validate(made, "made").equals(made)
    with pytest.raises(UserError, match="made: no column speed"):
        validate(made.drop("speed"), "made")
    with pytest.raises(UserError, match="made: no rows"):
        validate(made.clear(), "made")
    with pytest.raises(UserError, match="made, column x: String found, Float64 expected"):
        validate(made.with_columns(x=pl.lit("here")), "made")
    holed = made.with_columns(x=pl.when(pl.int_range(pl.len()) == 7).then(None).otherwise("x"))
    with pytest.raises(UserError, match="made, line 9, column x: None is not a finite number"):
        validate(holed, "made")
