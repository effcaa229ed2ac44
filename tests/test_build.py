"""Environments and drivers built from plain config dataclasses."""

import sys

import pytest
from reference.refusals import user_error

from ganlane.agents.drivers import MobilDriver
from ganlane.build import make_driver, make_traffic
from ganlane.settings.driving import IdmParameters, MobilParameters
from ganlane.settings.env import EnvConfig
from ganlane.settings.recordings import RealismConfig
from ganlane.settings.traffic import (
    HighwayEnvTrafficConfig,
    IdmMobilTrafficConfig,
    SumoTrafficConfig,
)
from ganlane.sim.random import Stream

ROAD = EnvConfig(
    lanes=2,
    idm=IdmParameters(headway_s=1.2),
    mobil=MobilParameters(politeness_side=0.0),
)


def test_rules_of_the_road_reach_traffic_and_driver():
    traffic = make_traffic(IdmMobilTrafficConfig(), ROAD, Stream.REPORT)
    assert (traffic.road.lanes, traffic.stream) == (2, Stream.REPORT)
    assert traffic.idm.headway_s == 1.2
    assert traffic.mobil.politeness_side == 0.0
    driver = make_driver("mobil", ROAD).policy
    assert isinstance(driver, MobilDriver)
    assert driver.mobil.politeness_side == 0.0
    assert driver.idm.headway_s == 1.2


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
    with user_error(rf"pip install 'ganlane\[{extra}\]'"):
        make_traffic(config, EnvConfig())


@pytest.mark.parametrize("config", [SumoTrafficConfig(), HighwayEnvTrafficConfig()])
def test_a_realism_card_has_no_ego_to_drive_around(config):
    with user_error("drives around an ego only"):
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
