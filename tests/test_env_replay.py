"""The environment on recorded scenes.

Its roads, its ends, and vehicles that leave within a decision.
"""

from __future__ import annotations

import polars as pl
import pytest
import torch
from reference.synthetic import SyntheticTraffic, synthetic_scenes
from reference.worlds import Track, assert_same_tracks, step, tracks
from torchrl.envs.utils import check_env_specs

from ganlane import keys
from ganlane.agents.drivers import KeepLaneDriver, MobilDriver, RandomLegalDriver
from ganlane.data import sort
from ganlane.env import EpisodeParameters, HighwayEnv
from ganlane.sim.random import episode_key
from ganlane.traffic import ReplayTraffic


@pytest.fixture(scope="module")
def recordings() -> pl.DataFrame:
    """Scenes of 2, 3 and 4 lanes, each a second shorter than the last.

    Every third driver leaves at 4.5 s.
    """
    parts = []
    for k in range(3):
        scene = synthetic_scenes(SyntheticTraffic(scenes=1, lanes=2 + k, seconds=9.0 - k), seed=k)
        scene = scene.filter((pl.col("vehicle") % 3 > 0) | (pl.col("frame") <= 45))
        parts.append(scene.with_columns(scene=pl.lit(f"scene-{k}")))
    return sort(pl.concat(parts))


def make(recordings: pl.DataFrame, rows: int, period_s: float = 1.0, **others) -> HighwayEnv:
    traffic = ReplayTraffic(recordings=recordings, least_s=5.0)
    return HighwayEnv(
        traffic, rows, episode=EpisodeParameters(decision_period_s=period_s), **others
    )


def test_the_specs_hold(recordings):
    check_env_specs(make(recordings, 5))


def test_an_episode_is_truncated_at_the_step_where_its_scene_ends(recordings):
    env = make(recordings, 32)
    td = env.reset()
    steps = env.traffic.steps_of(episode_key(0, td[keys.SEED], td[keys.EPISODE]))
    driver = KeepLaneDriver(env.road)
    running = torch.ones(32, dtype=torch.bool)
    for _ in range(10):
        stepped, td = env.step_and_maybe_reset(driver(td))
        after = stepped["next"]
        first = running & after["done"][:, 0]
        scene_end = after[keys.EVENTS, "scene_end"][:, 0]
        assert torch.equal(after[keys.STEP][first & scene_end], steps[first & scene_end])
        assert torch.equal(scene_end, (after["truncated"] & ~after["terminated"])[:, 0])
        assert not after[keys.EVENTS, "timeout"].any()
        running &= ~first
    assert not running.any()


def test_every_row_has_the_lanes_of_its_scene(recordings):
    env = make(recordings, 64)
    td = env.reset()
    lanes = 2 + env.traffic.scene_of(episode_key(0, td[keys.SEED], td[keys.EPISODE]))
    assert torch.equal(td[keys.ROAD, "lanes"][:, 0], lanes)
    width = td[keys.ROAD, "lane_width_m"][:, 0]
    for _ in range(2):
        ego = td[keys.VEHICLES, "target_lane"][:, 0]
        free = td[keys.EGO, "change_direction"] == 0
        after = step(env, td, keys.LEFT)
        left = after[keys.EVENTS, "out_of_road"][:, 0]
        assert torch.equal(left, (ego == lanes - 1) & free)
        vehicles = after[keys.VEHICLES]
        changing = after[keys.EGO, "change_direction"] == 1
        # The change aims at the next lane's centre on this road.
        expected = 1.0 - (vehicles["target_lane"][:, 0] * width - vehicles["y"][:, 0]).abs() / width
        torch.testing.assert_close(
            after[keys.EGO, "change_progress"][changing], expected[changing].clamp(0, 1)
        )
        td = after.exclude("reward")
        for _ in range(3):
            td = step(env, td).exclude("reward")
    assert 0 < left.sum() < 64


@pytest.mark.parametrize("driver", [MobilDriver, RandomLegalDriver])
def test_drivers_stay_on_the_road_of_their_row(recordings, driver):
    env = make(recordings, 48)
    td = env.reset()
    driver = driver(env.road)
    for _ in range(20):
        stepped, td = env.step_and_maybe_reset(driver(td))
        assert not stepped["next", keys.EVENTS, "out_of_road"].any()
    assert td[keys.EPISODE].min() >= 48


def test_an_episode_is_the_same_bits_in_every_batch_and_after_automatic_resets(recordings):
    def driven(rows: int, decisions: int) -> dict[int, Track]:
        env = make(recordings, rows)
        driver = MobilDriver(env.road)
        return tracks(env, decisions, lambda td: driver(td)["action"])

    wide = driven(24, 12)
    assert min(len(track) for track in wide.values()) >= 4
    assert_same_tracks(driven(1, 60), wide, at_least=4)
