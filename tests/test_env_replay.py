"""The environment on recorded scenes.

Its roads, its ends, and vehicles that leave within a decision.
"""

import json
from pathlib import Path

import polars as pl
import pytest
import torch
from reference.refusals import user_error
from reference.synthetic import varied_scenes
from reference.worlds import run, step
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from ganlane import keys
from ganlane.agents.drivers import KeepLaneDriver, MobilDriver, RandomLegalDriver
from ganlane.env import HighwayEnv
from ganlane.evaluation.episodes import _episode_rows
from ganlane.evaluation.measures import first_marks
from ganlane.settings.road import FAR_M, WALL
from ganlane.sim.random import episode_key
from ganlane.sim.state import Vehicles
from ganlane.traffic import ReplayTraffic
from ganlane.view.record import EpisodeLabel


@pytest.fixture(scope="module")
def recordings() -> pl.DataFrame:
    return varied_scenes(3)


def make(recordings: pl.DataFrame, rows: int, roads: Path | None = None) -> HighwayEnv:
    return HighwayEnv(ReplayTraffic(recordings=recordings, least_s=5.0, roads=roads), rows)


def random_keys(td) -> torch.Tensor:
    return episode_key(0, td[keys.SEED], td[keys.EPISODE])


def test_the_specs_hold(recordings):
    check_env_specs(make(recordings, 5))


def test_an_episode_is_truncated_at_the_step_where_its_scene_ends(recordings):
    env = make(recordings, 32)
    td = env.reset()
    steps = env.traffic.steps_of(random_keys(td))
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
    # Half of them go a lane further to the left than at the start.
    *_, td = run(env, 4, lambda td: keys.LEFT * (td[keys.STEP] == 0) * (td[keys.EPISODE] % 2))
    lanes, width = (td[keys.ROAD, name][:, 0] for name in ("lanes", "lane_width_m"))
    free = td[keys.EGO, "change_direction"] == 0
    leftmost = (td[keys.VEHICLES, "target_lane"][:, 0] == lanes - 1) & free
    after = step(env, td, keys.LEFT)
    assert torch.equal(after[keys.EVENTS, "out_of_road"][:, 0], leftmost)
    assert 0 < leftmost.sum() < 64
    # The change aims at the next lane's centre on this road.
    ego = Vehicles.of(after[keys.VEHICLES]).at(0)
    changing = after[keys.EGO, "change_direction"] == 1
    progress = 1.0 - (ego.target_lane * width - ego.y).abs() / width
    torch.testing.assert_close(
        after[keys.EGO, "change_progress"][changing], progress[changing].clamp(0, 1)
    )


@pytest.mark.parametrize("driver", [MobilDriver, RandomLegalDriver])
def test_drivers_stay_on_the_road_of_their_row(recordings, driver):
    env = make(recordings, 48)
    td = env.reset()
    driver = driver(env.road)
    for _ in range(20):
        stepped, td = env.step_and_maybe_reset(driver(td))
        assert not stepped["next", keys.EVENTS, "out_of_road"].any()
    assert td[keys.EPISODE].min() >= 48


# Roads whose lanes end


def roads_of(folder: Path, content: dict) -> Path:
    file = folder / "roads.json"
    file.write_text(json.dumps(content))
    return file


@pytest.fixture(scope="module")
def roads(tmp_path_factory) -> Path:
    """The right lane of the widest scene begins 50 m down the recorded road and has a wall."""
    ramp = {"begin_m": 50, "end_m": 250, "end": "wall"}
    return roads_of(tmp_path_factory.mktemp("roads"), {"scene-2": [ramp, {}, {}, {}]})


def test_lanes_end_where_the_roads_say_seen_from_the_start_of_each_episode(recordings, roads):
    env = make(recordings, 64, roads)
    check_env_specs(env)
    td = env.reset()
    key, traffic, road = random_keys(td), env.traffic, td[keys.ROAD]
    ends = traffic.scene[traffic.start_of(key)] == 2
    assert 0 < ends.sum() < 64
    start_m = traffic.samples[traffic.starts[traffic.start_of(key), 0], 0]
    torch.testing.assert_close(road["wall_m"][ends, 0], (250.0 - start_m[ends]).float())
    assert (road["wall_m"][~ends] == FAR_M).all()
    # A state of each step still has them.
    assert torch.equal(step(env, td)[keys.ROAD, "wall_m"], road["wall_m"])


def at_fault_in(state: TensorDict, env: HighwayEnv) -> list[bool | None]:
    """What is told of episodes that end in this state, by row."""
    rows = env.batch_size[0]
    none = torch.zeros(rows)
    counted = ("reward", *keys.EVENT_COUNTS, "squared_acceleration")
    parts = {
        "last": state,
        "marks": first_marks(none),
        "sums": TensorDict(dict.fromkeys(counted, none), [rows]),
    }
    driven = TensorDict(parts, [rows])
    return _episode_rows(driven, list(range(rows)), 0, env.road)["at_fault"].to_list()


def test_the_ego_brakes_for_the_wall_of_its_own_row_and_runs_into_it(recordings, tmp_path):
    """From 10 m/s it needs 2.5 m at 20 m/s2; where nobody else has ever been."""
    wall = {"end_m": 5000, "end": "wall"}
    env = make(recordings, 32, roads_of(tmp_path, {"scene-2": [wall, {}, {}, {}]}))
    td = env.reset()
    wall_m = td[keys.ROAD, "wall_m"][:, 0]
    ends = wall_m < FAR_M
    front_m = 0.5 * td[keys.VEHICLES, "length"][:, 0]
    x = torch.where(ends, wall_m, 6000.0) - 1.5 - front_m
    place = {"x": x, "target_lane": 0, "y": 0.0, "heading": 0.0, "speed": 10.0}
    for name, value in place.items():
        td[keys.VEHICLES, name][:, 0] = value
    after = step(env, td)
    assert torch.equal(after[keys.EVENTS, "hard_crash"][:, 0], ends)
    assert at_fault_in(after, env) == [True if near else None for near in ends.tolist()]
    speed = after[keys.VEHICLES, "speed"][:, 0]
    assert speed[ends].max() < 10.0 < speed[~ends].min()


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ({"scene-3": [{}]}, r"no scene scene-3 in recordings \(did you mean 'scene-2'\?\)"),
        ({"scene-2": [{}, {}]}, "scene-2: 2 lanes; expected the 4 of the recording"),
    ],
)
def test_roads_of_other_scenes_are_refused(recordings, tmp_path, content, what):
    with user_error(what):
        make(recordings, 1, roads_of(tmp_path, content))


def test_a_film_shows_where_the_lanes_of_a_recorded_scene_end(recordings, roads):
    env = make(recordings, 32, roads)
    td = env.reset()
    walls = td[keys.ROAD, "wall_m"][:, 0] < FAR_M
    for row, has_wall in enumerate(walls.tolist()):
        label = EpisodeLabel.of(td, env.road, "ego", "replay", row)
        assert len(label.stretches) == label.lanes
        assert (label.stretches[0].end == WALL) == has_wall
