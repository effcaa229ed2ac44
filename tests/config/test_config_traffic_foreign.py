"""SUMO and HighwayEnv as options of the group ``traffic``."""

import sys

import pytest

from ganlane.build import make_traffic
from ganlane.config.env import EnvConfig
from ganlane.config.evaluate import EvaluateConfig
from ganlane.config.realism import RealismConfig
from ganlane.config.traffic_foreign import HighwayEnvTrafficConfig, SumoTrafficConfig
from ganlane.errors import UserError


@pytest.mark.parametrize(
    ("module", "config", "extra"),
    [("libsumo", SumoTrafficConfig(), "sumo"), ("highway_env", HighwayEnvTrafficConfig(), "bench")],
)
def test_where_the_package_is_missing_a_sentence_names_the_extra(monkeypatch, module, config, extra):
    monkeypatch.setattr("ganlane.traffic.foreign.packages.find_spec", lambda name: None)
    monkeypatch.delitem(sys.modules, module, raising=False)
    with pytest.raises(UserError, match=rf"pip install 'ganlane\[{extra}\]'"):
        make_traffic(config, EnvConfig())


def test_evaluate_knows_both_by_name():
    chosen = EvaluateConfig(traffics=["sumo", "highway_env"]).chosen_traffics()
    assert {name: config.label() for name, config in chosen.items()} == {"sumo": "sumo", "highway_env": "highway_env"}


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("truck_share", 1.5, "from 0 to 1"),
        ("truck_length_m", 40.0, "from 4.5 to 25"),
        ("lane_change_s", 0.2, "at least 1"),
        ("speed_wander", -0.1, "from 0 to 0.2"),
    ],
)
def test_a_number_out_of_range_is_refused(key, value, words):
    with pytest.raises(UserError, match=f"traffic.{key}={value:g}: expected.*{words}"):
        SumoTrafficConfig(**{key: value})


@pytest.mark.parametrize("config", [SumoTrafficConfig(), HighwayEnvTrafficConfig()])
def test_a_realism_card_has_no_ego_to_drive_around(config):
    with pytest.raises(UserError, match="drives around an ego only"):
        RealismConfig(traffic=config)


def test_the_first_scene_is_that_of_the_environment():
    pytest.importorskip("libsumo", reason="SUMO is not installed: pip install 'ganlane[sumo]'")
    env = EnvConfig(spread_m=300.0, rear_speed_mps=(12.0, 13.0))
    scenes = make_traffic(SumoTrafficConfig(truck_share=0.4), env).scenes(9)
    assert scenes.cars.parameters == env.spawn_parameters()
    assert scenes.share == 0.4
