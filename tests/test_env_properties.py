"""What holds in every environment, whatever the configuration, the scene and the actions."""

import itertools
import random
from pathlib import Path

import pytest
import torch
from trial import soak

from ganlane import keys
from ganlane.settings.observation import largest_number
from ganlane.sim.state import Vehicles

FIXED = ("length", "width", "desired_speed", "visibility", "valid")


def check_motion(frames: list[Vehicles], slides: bool) -> None:
    """Of one physics step after the other; with ``slides`` the speed of the others is theirs along
    the road alone.
    """
    for last, after in itertools.pairwise(frames):
        moved = torch.hypot(after.x - last.x, after.y - last.y)
        if slides:
            moved[:, 1:] = (after.x - last.x)[:, 1:].abs()
        most = torch.maximum(last.speed, after.speed) * keys.PHYSICS_STEP_S
        assert (moved <= most + 1e-4).all()
        assert (after.speed >= 0.0).all()
        assert ((after.target_lane - last.target_lane).abs() <= 1).all()
        assert all(torch.equal(getattr(after, name), getattr(last, name)) for name in FIXED)


@pytest.mark.parametrize("number", range(12))
def test_what_must_hold_does_in_the_trials_random_configurations(number, monkeypatch):
    """The paper's literal lane changers slide: equation 11's lateral speed comes on top of their
    speed along the road.
    """
    monkeypatch.setattr(soak, "RECORDINGS", Path("none"))
    choice = soak.random_choice(random.Random(number))
    choice |= {"num_envs": 3, "truck_share": 0.0}
    env = soak.make(choice)
    largest = largest_number(choice["observation"], 4.5)
    generator = torch.Generator().manual_seed(number)
    frames: list[Vehicles] = []
    env.base_env.recorder = lambda vehicles, running: frames.append(vehicles)
    td = env.reset()
    for _ in range(3):
        frames[:] = [Vehicles.of(td[keys.VEHICLES])]
        before = td.set("action", torch.randint(3, (3,), generator=generator))
        stepped, td = env.step_and_maybe_reset(before)
        after = stepped["next"]
        assert list(soak.violations(env.base_env, choice, before, after, td)) == []
        assert env.observation_spec.contains(after.select(*env.observation_spec.keys()))
        assert (after[keys.OBSERVATION][:, 1:].abs() <= largest).all()
        check_motion(frames, slides=choice["traffic"]["name"] in ("gan", "mixed"))
