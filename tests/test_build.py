"""Environments and drivers built from plain config dataclasses."""

from __future__ import annotations

import sys

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from ganlane.agents.drivers import DRIVERS, MobilDriver
from ganlane.build import make_driver, make_env, make_traffic
from ganlane.errors import UserError
from ganlane.settings.driving import IdmParameters, MobilParameters
from ganlane.settings.env import EnvConfig
from ganlane.settings.observation import FORMS, ObservationConfig
from ganlane.settings.recordings import RealismConfig
from ganlane.settings.traffic import (
    HighwayEnvTrafficConfig,
    IdmMobilTrafficConfig,
    IdmTrafficConfig,
    SumoTrafficConfig,
)
from ganlane.sim.random import Stream

ROAD = EnvConfig(
    lanes=2,
    idm=IdmParameters(headway_s=1.2),
    mobil=MobilParameters(politeness_side=0.0),
)


@pytest.mark.parametrize("form", FORMS)
def test_built_environments_keep_their_specs(form):
    check_env_specs(
        make_env(
            make_traffic(IdmTrafficConfig(), ROAD),
            ROAD,
            ObservationConfig(form=form),
            num_envs=2,
        )
    )


def test_a_reset_runs_the_episodes_that_were_asked_for():
    env = make_env(make_traffic(IdmTrafficConfig(), ROAD), ROAD, num_envs=3)
    wanted = TensorDict(
        {
            "seed": torch.tensor([5, 5, 6]),
            "episode": torch.tensor([7, 8, 9]),
        },
        [3],
    )
    start = env.reset(wanted)
    assert start["episode"].tolist() == [7, 8, 9]
    assert start["seed"].tolist() == [5, 5, 6]
    alone = make_env(make_traffic(IdmTrafficConfig(), ROAD), ROAD, num_envs=1).reset(wanted[2:])
    assert torch.equal(alone["observation"], start["observation"][2:])


def test_rules_of_the_road_reach_traffic_and_driver():
    traffic = make_traffic(IdmMobilTrafficConfig(), ROAD, Stream.REPORT)
    assert (traffic.road.lanes, traffic.stream) == (2, Stream.REPORT)
    assert traffic.idm.headway_s == 1.2
    assert traffic.mobil.politeness_side == 0.0
    driver = make_driver("mobil", ROAD).policy
    assert isinstance(driver, MobilDriver)
    assert driver.mobil.politeness_side == 0.0
    assert driver.idm.headway_s == 1.2


@pytest.mark.parametrize("name", DRIVERS)
def test_every_driver_drives(name):
    env = make_env(make_traffic(IdmTrafficConfig(), ROAD), ROAD, num_envs=2)
    action = make_driver(name, ROAD).policy(env.reset())["action"]
    assert action.shape == (2,)
    assert action.dtype == torch.int64


def test_an_unknown_driver_is_refused_with_the_known_ones():
    with pytest.raises(
        UserError,
        match=r"agent nobody: unknown; choose one of random, .*agent_idm",
    ):
        make_driver("nobody", ROAD)


@pytest.mark.parametrize(
    ("module", "config", "extra"),
    [
        ("libsumo", SumoTrafficConfig(), "sumo"),
        ("highway_env", HighwayEnvTrafficConfig(), "bench"),
    ],
)
def test_where_the_package_is_missing_a_sentence_names_the_extra(
    monkeypatch, module, config, extra
):
    for name in [name for name in sys.modules if name.startswith(f"{module}.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UserError, match=rf"pip install 'ganlane\[{extra}\]'"):
        make_traffic(config, EnvConfig())


@pytest.mark.parametrize("config", [SumoTrafficConfig(), HighwayEnvTrafficConfig()])
def test_a_realism_card_has_no_ego_to_drive_around(config):
    with pytest.raises(UserError, match="drives around an ego only"):
        RealismConfig(traffic=config)


def test_the_first_scene_is_that_of_the_environment():
    pytest.importorskip(
        "libsumo",
        reason="SUMO is not installed: pip install 'ganlane[sumo]'",
    )
    env = EnvConfig(spread_m=300.0, rear_speed_mps=(12.0, 13.0))
    scenes = make_traffic(SumoTrafficConfig(truck_share=0.4), env).scenes(9)
    assert scenes.cars.parameters == env.spawn_parameters()
    assert scenes.share == 0.4
