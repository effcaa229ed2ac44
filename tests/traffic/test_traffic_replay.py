"""Replay: recorded scenes around the ego, the same for everybody who asks for the same episode."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
import torch
from reference.scene_csv import write_scene_csv
from reference.synthetic import SyntheticTraffic, synthetic_scenes
from scipy.stats import chisquare

from ganlane import keys
from ganlane.data import default_scenes, sort
from ganlane.errors import UserError
from ganlane.settings.driving import IdmParameters, Visibility
from ganlane.sim import Vehicles
from ganlane.sim.collisions import ego_overlaps
from ganlane.sim.random import episode_key
from ganlane.traffic import ReplayTraffic

WIDTH = 3.5


def track(vehicle, frames, x, speed, lane, scene="s", length=4.0, width=2.0) -> pl.DataFrame:
    """A vehicle at a steady speed on a lane's centre."""
    frame = pl.DataFrame({"frame": list(frames)})
    same = {
        "vehicle": vehicle,
        "y": lane * WIDTH,
        "speed": float(speed),
        "lane": lane,
    }
    same |= {"length": length, "width": width, "scene": scene}
    constants = (pl.lit(value).alias(name) for name, value in same.items())
    return frame.select("frame", *constants, x=x + speed * 0.1 * pl.col("frame"))


def replay(*tracks: pl.DataFrame, least_s: float = 2.0, stream: int = 0) -> ReplayTraffic:
    return ReplayTraffic(stream, recordings=sort(pl.concat(tracks)), least_s=least_s)


def keys_of(episodes, stream: int = 0, seed: int = 0) -> torch.Tensor:
    number = torch.as_tensor(episodes, dtype=torch.int64)
    return episode_key(stream, torch.full_like(number, seed), number)


def start(traffic: ReplayTraffic, key: torch.Tensor, vehicles: int = 9) -> Vehicles:
    return traffic.scenes(vehicles)(key, torch.float64)


def play(
    traffic: ReplayTraffic,
    key: torch.Tensor,
    step: int,
    vehicles: int = 9,
) -> Vehicles:
    """The vehicles that ``move`` gives ``step`` steps after the start."""
    scene = start(traffic, key, vehicles)
    return traffic.move(scene, {}, key, torch.full_like(key, step - 1))[0]


# 2.1 s: an episode can only start at frame 0, where five cars stand at 0, 20, 30, 45 and 100 m.
FIVE = (
    track(1, range(21), 0.0, 20.0, 0),
    track(2, range(21), 20.0, 10.0, 0, length=6.0),
    track(3, range(21), 30.0, 12.0, 1, length=5.0, width=1.8),
    track(4, range(8), 45.0, 15.0, 2),
    track(5, range(21), 100.0, 15.0, 2),
)


def test_the_ego_takes_the_place_of_the_vehicle_nearest_the_middle():
    scene = start(replay(*FIVE), keys_of([0]))
    # Positions 0, 20, 30, 45, 100: their median is 30.
    names = (
        "x",
        "y",
        "speed",
        "length",
        "width",
        "target_lane",
        "desired_speed",
    )
    assert [getattr(scene, name)[0, 0].item() for name in names] == [
        0.0,
        WIDTH,
        12.0,
        5.0,
        1.8,
        1,
        25.0,
    ]
    assert scene.visibility[0].tolist() == [Visibility.BODY] * 9


def test_a_track_with_a_missing_frame_ends_there():
    holes = [frame for frame in range(21) if frame != 10]
    traffic = replay(*FIVE[1:3], track(9, holes, 33.0, 12.0, 2))
    valid = [play(traffic, keys_of([0]), step).valid[0, :3].tolist() for step in (9, 12)]
    assert valid == [[True, True, True], [True, False, True]]


def test_nobody_reacts_to_the_ego():
    traffic = ReplayTraffic(recordings=recorded(3))
    key = keys_of(range(16))
    scene = start(traffic, key)
    elsewhere = scene.with_(x=scene.x + 5.0, y=scene.y + 1.0, speed=scene.speed * 0.0)
    one, other = (
        traffic.move(at, {}, key, torch.full_like(key, 7))[0] for at in (scene, elsewhere)
    )
    assert all(
        map(
            torch.equal,
            one.columns(slice(1, None)),
            other.columns(slice(1, None)),
        )
    )
    assert all(map(torch.equal, other.at(0), elsewhere.at(0)))


def recorded(scenes: int = 4, seconds: float = 8.0, **others) -> pl.DataFrame:
    """Synthetic scenes of which the k-th has 2 + k % 3 lanes and loses its last k seconds."""
    parts = []
    for k in range(scenes):
        frame = synthetic_scenes(
            SyntheticTraffic(scenes=1, lanes=2 + k % 3, seconds=seconds, **others),
            seed=k,
        )
        cut = frame.filter(pl.col("frame") < round((seconds - 0.5 * k) * 10))
        parts.append(cut.with_columns(scene=pl.lit(f"scene-{k}")))
    return sort(pl.concat(parts))


def test_every_scene_is_equally_likely_and_every_start_within_it():
    traffic = ReplayTraffic(recordings=recorded())
    episodes = range(20_000)
    starts = traffic.start_of(keys_of(episodes))
    scenes = np.bincount(traffic.scene[traffic.start_of(keys_of(episodes))].numpy(), minlength=4)
    assert chisquare(scenes).pvalue > 1e-3
    within = np.bincount(starts[traffic.scene[traffic.start_of(keys_of(episodes))] == 2].numpy())
    assert chisquare(within[within > 0]).pvalue > 1e-3
    assert len(starts.unique()) == starts.max() + 1


def test_lanes_and_their_width_are_the_scenes_own():
    traffic = ReplayTraffic(recordings=recorded())
    key = keys_of(range(100))
    road = traffic.road_of(key, torch.float64)
    scene = traffic.scene[traffic.start_of(key)]
    assert road.lanes.shape == road.lane_width_m.shape == (100, 1)
    assert torch.equal(road.lanes[:, 0], 2 + scene % 3)
    assert (road.lane_width_m - 3.5).abs().max() < 0.2
    now = start(traffic, key)
    assert (now.target_lane < road.lanes).all()
    assert traffic.road.lanes == 4
    assert traffic.scenes_of_episodes(0, range(100)) == [
        f"scene-{number}" for number in scene.tolist()
    ]


def test_every_step_is_what_a_search_through_the_rows_finds():
    frame = sort(
        synthetic_scenes(
            SyntheticTraffic(scenes=2, vehicles=14, seconds=7.0, changing_share=0.6),
            seed=3,
        )
    )
    # Some come later and some leave early.
    frame = frame.filter(
        (pl.col("frame") >= 2 * (pl.col("vehicle") % 4))
        & (pl.col("frame") < 70 - pl.col("vehicle"))
    )
    traffic = ReplayTraffic(recordings=frame, least_s=3.0)
    key = keys_of(range(12))
    for row, (scene, steps) in enumerate(
        zip(
            traffic.scene[traffic.start_of(key)].tolist(),
            traffic.steps_of(key).tolist(),
        )
    ):
        rows = frame.filter(pl.col("scene") == traffic.scene_names[scene])
        first = rows["frame"].max() - steps
        here = rows.filter(pl.col("frame") == first)
        ending = rows.group_by("vehicle").agg(pl.col("frame").max().alias("end"))
        middle = here["x"].median()
        stays = here.join(ending, on="vehicle").filter(pl.col("end") >= first + 30)
        ego = min(
            stays.to_dicts(),
            key=lambda car: (abs(car["x"] - middle), car["vehicle"]),
        )
        others = [car for car in here.to_dicts() if car["vehicle"] != ego["vehicle"]]
        others.sort(
            key=lambda car: (
                np.hypot(car["x"] - ego["x"], car["y"] - ego["y"]),
                car["vehicle"],
            )
        )
        for step in (1, 17, steps):
            now = play(traffic, key[row : row + 1], step)
            for slot, car in enumerate(others[:8], start=1):
                samples = rows.filter(
                    (pl.col("vehicle") == car["vehicle"]) & (pl.col("frame") == first + step)
                ).to_dicts()
                assert now.valid[0, slot].item() == bool(samples)
                if samples:
                    seen = (
                        now.x[0, slot] + ego["x"],
                        now.y[0, slot],
                        now.speed[0, slot],
                        now.length[0, slot],
                    )
                    expected = [samples[0][name] for name in ("x", "y", "speed", "length")]
                    assert [value.item() for value in seen] == pytest.approx(expected)


def test_heading_and_acceleration_are_those_of_the_path():
    frame = np.arange(60)
    time = frame * 0.1
    path = 10.0 * time + 0.5 * time**2
    # Accelerating at 1 m/s2 along a line that rises by one in two hundred; beside it somebody
    # stands.
    moving = track(1, frame, 0.0, 10.0, 0).with_columns(x=path, y=path / 200.0, speed=10.0 + time)
    samples = replay(moving, track(2, frame, 30.0, 0.0, 1), least_s=3.0).samples
    heading, acceleration = (
        samples[:, keys.VEHICLE_FLOATS.index(name)] for name in ("heading", "acceleration")
    )
    assert heading[:60].tolist() == pytest.approx([np.arctan(1 / 200.0)] * 60)
    assert acceleration[:60].tolist() == pytest.approx([1.0] * 60)
    assert heading[60:].abs().max() == acceleration[60:].abs().max() == 0.0


def test_a_scene_file_is_read(tmp_path):
    frame = synthetic_scenes(SyntheticTraffic(scenes=2, seconds=6.0))
    write_scene_csv(frame, tmp_path / "mine.csv")
    assert ReplayTraffic(path=tmp_path / "mine.csv").scene_names == (
        "synthetic-0",
        "synthetic-1",
    )


def test_without_recordings_it_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setenv("GANLANE_DATA", str(tmp_path))
    with pytest.raises(
        UserError,
        match=r"no recordings found.*traffic.path=FILE.*GANLANE_DATA",
    ):
        ReplayTraffic()


def test_recordings_that_are_too_short_are_refused():
    with pytest.raises(UserError, match="no vehicle is recorded for 3 s"):
        replay(*FIVE, least_s=3.0)


@pytest.fixture(scope="module")
def us101() -> ReplayTraffic:
    try:
        default_scenes()
    except UserError as missing:
        pytest.skip(str(missing))
    return ReplayTraffic(stream=2)


def test_the_us101_scenes_can_all_be_replayed(us101):
    key = keys_of(range(2000), stream=2)
    assert len(us101.scene_names) == 11
    assert set(us101.scene[us101.start_of(key)].tolist()) == set(range(11))
    scene = us101.scenes(9)(key, torch.float32)
    # Nobody starts in a crash: the ego's size is that of the vehicle it replaces.
    assert not ego_overlaps(scene).any()
    assert set(us101.road_of(key).lanes.unique().tolist()) == {5, 6, 7}


# Starts that are driven once each

STEADY = [
    track(1, range(30), 0.0, 20.0, 0, scene="long"),
    track(2, range(30), 60.0, 20.0, 0, scene="long"),
    track(1, range(25), 0.0, 20.0, 0, scene="short"),
    track(2, range(25), 60.0, 20.0, 0, scene="short"),
]


def test_every_start_is_driven_once_by_its_first_episode():
    traffic = replay(*STEADY)
    episodes = traffic.episodes_once(3, IdmParameters())
    starts = traffic.start_of(keys_of(episodes, seed=3)).tolist()
    assert sorted(starts) == list(range(10 + 5))
    assert episodes == sorted(episodes)
    before = traffic.start_of(keys_of(range(max(episodes)), seed=3)).tolist()
    for episode, first in zip(episodes, starts):
        assert first not in before[:episode]


def test_starts_at_which_the_ego_would_brake_hard_at_once_are_left_out():
    close = [
        track(1, range(30), 0.0, 20.0, 0, scene="close"),
        track(2, range(30), 7.0, 15.0, 0, scene="close"),
    ]
    traffic = replay(*STEADY, *close)
    episodes = traffic.episodes_once(0, IdmParameters())
    assert set(traffic.scenes_of_episodes(0, episodes)) == {"long", "short"}


def test_episodes_of_one_recorded_car_are_known_by_its_number():
    traffic = replay(*STEADY)
    episodes = traffic.episodes_once(0, IdmParameters())
    cars = traffic.cars_of_episodes(0, episodes)
    scenes = traffic.scenes_of_episodes(0, episodes)
    assert len(set(zip(cars, scenes))) == len(set(cars)) == 2
