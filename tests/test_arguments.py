"""What a class of the user's own is called with: what its own constructor names."""

from __future__ import annotations

from typing import NamedTuple

from reference.refusals import user_error
from tensordict.nn import TensorDictModuleBase

from ganlane.arguments import call_with, signature_of


class Anything:
    def __new__(cls, *args, **kwargs):
        return super().__new__(cls)


class Named(Anything):
    def __init__(self, road, stream=0):
        self.given = (road, stream)


class Inherits(Named):
    pass


class Module(TensorDictModuleBase):
    def __init__(self, road):
        super().__init__()
        self.road = road


class Pair(NamedTuple):
    road: int
    stream: int = 0


class Nothing:
    pass


def test_a_constructor_goes_before_the_new_of_a_base_on_every_version_of_python():
    for kind in (Named, Inherits, Pair):
        assert list(signature_of(kind).parameters) == ["road", "stream"]
    assert list(signature_of(Module).parameters) == ["road"]
    assert list(signature_of(Nothing).parameters) == []
    assert list(signature_of(lambda road: road).parameters) == ["road"]


def test_it_is_called_with_what_it_names_and_no_more():
    offered = {"road": 3, "idm": 5}
    assert call_with(Inherits, offered, {"stream": 2}, "agents").given == (3, 2)
    assert call_with(Module, offered, {}, "agents").road == 3
    assert isinstance(call_with(Nothing, offered, {}, "agents"), Nothing)
    with user_error(r"agents=.*Named: cannot be called with .*; it takes road, stream"):
        call_with(Named, {"idm": 5}, {}, "agents")
