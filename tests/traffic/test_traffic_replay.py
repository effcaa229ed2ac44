"""Replay: recorded scenes around the ego, the same for everybody who asks for the same episode."""

import numpy as np
import polars as pl
import pytest
import torch
from reference.refusals import user_error
from reference.scene_csv import write_scene_csv
from reference.synthetic import synthetic_scenes, varied_scenes
from reference.worlds import episode_keys
from scipy.stats import chisquare

from ganlane import keys
from ganlane.data import sort
from ganlane.errors import UserError
from ganlane.settings.driving import IdmParameters, Visibility
from ganlane.sim.collisions import ego_overlaps
from ganlane.traffic import ReplayTraffic

WIDTH = 3.5


def track(vehicle, frames, x, speed, lane, scene="s"):
    """A vehicle at a steady speed on a lane's centre."""
    frame = np.array(frames)
    same = {"vehicle": vehicle, "y": lane * WIDTH, "speed": float(speed), "lane": lane}
    same |= {"length": 4.0, "width": 2.0, "scene": scene}
    return pl.DataFrame({"frame": frame, "x": x + speed * 0.1 * frame}).with_columns(
        pl.lit(value).alias(name) for name, value in same.items()
    )


def replay(*tracks, least_s=2.0):
    return ReplayTraffic(recordings=sort(pl.concat(tracks)), least_s=least_s)


def start(traffic, key):
    return traffic.scenes(9)(key, torch.float64)


def play(traffic, key, step):
    """The vehicles that ``move`` gives ``step`` steps after the start: the others wherever the ego
    and they are by then, the ego as it is.
    """
    scene = start(traffic, key)
    elsewhere = scene.with_(x=scene.x + 5.0, y=scene.y + 1.0, speed=scene.speed * 0.0)
    moved = traffic.move(elsewhere, {}, key, torch.full_like(key, step - 1))[0]
    assert all(map(torch.equal, moved.at(0), elsewhere.at(0)))
    return moved


# 2.1 s: an episode can only start at frame 0.
TWO = (track(2, range(21), 20.0, 10.0, 0), track(3, range(21), 30.0, 12.0, 1))


def test_a_track_with_a_missing_frame_ends_there():
    holes = [frame for frame in range(21) if frame != 10]
    traffic = replay(*TWO, track(9, holes, 33.0, 12.0, 2))
    valid = [play(traffic, episode_keys([0]), step).valid[0, :3].tolist() for step in (9, 12)]
    assert valid == [[True, True, True], [True, False, True]]


def test_every_scene_is_equally_likely_and_every_start_within_it():
    traffic = ReplayTraffic(recordings=varied_scenes(4))
    key = episode_keys(range(20_000))
    starts = traffic.start_of(key)
    scenes = traffic.scene[starts]
    assert chisquare(np.bincount(scenes.numpy(), minlength=4)).pvalue > 1e-3
    within = np.bincount(starts[scenes == 2].numpy())
    assert chisquare(within[within > 0]).pvalue > 1e-3
    assert len(starts.unique()) == starts.max() + 1


def test_lanes_and_their_width_are_the_scenes_own():
    traffic = ReplayTraffic(recordings=varied_scenes(4))
    key = episode_keys(range(100))
    road = traffic.road_of(key, torch.float64)
    scene = traffic.scene[traffic.start_of(key)]
    assert road.lanes.shape == road.lane_width_m.shape == (100, 1)
    assert torch.equal(road.lanes[:, 0], 2 + scene % 3)
    assert (road.lane_width_m - 3.5).abs().max() < 0.2
    assert (start(traffic, key).target_lane < road.lanes).all()
    assert traffic.road.lanes == 4
    names = [f"scene-{number}" for number in scene.tolist()]
    assert traffic.scenes_of_episodes(0, range(100)) == names


def test_every_step_is_what_a_search_through_the_rows_finds_and_nobody_reacts_to_the_ego():
    frame = synthetic_scenes(seed=3, scenes=2, vehicles=14, seconds=7.0, changing_share=0.6)
    # Some come later and some leave early.
    frame = frame.filter(
        (pl.col("frame") >= 2 * (pl.col("vehicle") % 4))
        & (pl.col("frame") < 70 - pl.col("vehicle"))
    )
    traffic = ReplayTraffic(recordings=sort(frame), least_s=3.0)
    key = episode_keys(range(12))
    scenes = traffic.scene[traffic.start_of(key)]
    for row, (scene, steps) in enumerate(zip(scenes, traffic.steps_of(key))):
        rows = frame.filter(pl.col("scene") == traffic.scene_names[scene])
        first = rows["frame"].max() - int(steps)
        at = {
            number: {car["vehicle"]: car for car in now.to_dicts()}
            for (number,), now in rows.group_by("frame")
        }
        middle = np.median([car["x"] for car in at[first].values()])
        # The ego takes the place of the vehicle nearest the middle that stays for long enough.
        ego = min(
            (car for number, car in at[first].items() if number in at[first + 30]),
            key=lambda car: (abs(car["x"] - middle), car["vehicle"]),
        )
        others = sorted(
            (car for car in at[first].values() if car is not ego),
            key=lambda car: (np.hypot(car["x"] - ego["x"], car["y"] - ego["y"]), car["vehicle"]),
        )
        slots = [car["vehicle"] for car in (ego, *others)][:9]
        scene_at = {0: start(traffic, key[row : row + 1])}
        scene_at |= {step: play(traffic, key[row : row + 1], step) for step in (1, 17, int(steps))}
        for step, scene in scene_at.items():
            # The ego is not replayed.
            for slot in range(1 if step else 0, 9):
                sample = at[first + step].get(slots[slot])
                assert scene.valid[0, slot].item() == (sample is not None)
                if sample is not None:
                    names = ("x", "y", "speed", "length", "width")
                    seen = {name: getattr(scene, name)[0, slot].item() for name in names}
                    expected = {name: sample[name] for name in names}
                    assert seen == pytest.approx({**expected, "x": sample["x"] - ego["x"]})
    ego = scene_at[0].at(0)
    assert (ego.desired_speed, ego.visibility) == (25.0, Visibility.BODY)


def test_heading_and_acceleration_are_those_of_the_path():
    time = np.arange(60) * 0.1
    path = 10.0 * time + 0.5 * time**2
    # Accelerating at 1 m/s2 along a line that rises by one in two hundred; beside it somebody
    # stands.
    moving, standing = (track(number, range(60), 30.0, 0.0, 1) for number in (1, 2))
    moving = moving.with_columns(x=path, y=path / 200.0, speed=10.0 + time)
    samples = replay(moving, standing, least_s=3.0).samples
    heading, acceleration = (
        samples[:, keys.VEHICLE_FLOATS.index(name)] for name in ("heading", "acceleration")
    )
    assert heading[:60].tolist() == pytest.approx([np.arctan(1 / 200.0)] * 60)
    assert acceleration[:60].tolist() == pytest.approx([1.0] * 60)
    assert heading[60:].abs().max() == acceleration[60:].abs().max() == 0.0


def test_a_scene_file_is_read(tmp_path):
    frame = synthetic_scenes(scenes=2, seconds=6.0)
    write_scene_csv(frame, tmp_path / "mine.csv")
    assert ReplayTraffic(path=tmp_path / "mine.csv").scene_names == (
        "synthetic-0",
        "synthetic-1",
    )


@pytest.mark.usefixtures("no_recordings")
def test_without_recordings_it_says_what_to_do():
    with user_error(r"no recordings found.*traffic.path=FILE.*GANLANE_DATA"):
        ReplayTraffic()


def test_recordings_that_are_too_short_are_refused():
    with user_error("no vehicle is recorded for 3 s"):
        replay(*TWO, least_s=3.0)


@pytest.mark.usefixtures("us101_scenes")  # skips where they are not
def test_the_us101_scenes_can_all_be_replayed():
    us101 = ReplayTraffic(stream=2)
    key = episode_keys(range(2000), stream=2)
    assert len(us101.scene_names) == 11
    assert set(us101.scene[us101.start_of(key)].tolist()) == set(range(11))
    # Nobody starts in a crash: the ego's size is that of the vehicle it replaces.
    assert not ego_overlaps(us101.scenes(9)(key, torch.float32)).any()
    assert set(us101.road_of(key).lanes.unique().tolist()) == {5, 6, 7}


# Starts that are driven once each


def two(scene, frames, second_x, second_speed):
    """The first of the cars in a lane drives 20 m/s."""
    first = track(1, range(frames), 0.0, 20.0, 0, scene)
    return first, track(2, range(frames), second_x, second_speed, 0, scene)


STEADY = (*two("long", 30, 60.0, 20.0), *two("short", 25, 60.0, 20.0))


def test_every_start_is_driven_once_by_its_first_episode():
    traffic = replay(*STEADY)
    episodes = traffic.episodes_once(3, IdmParameters())
    starts = traffic.start_of(episode_keys(episodes, seed=3)).tolist()
    assert sorted(starts) == list(range(10 + 5))
    assert episodes == sorted(episodes)
    before = traffic.start_of(episode_keys(range(max(episodes)), seed=3)).tolist()
    for episode, first in zip(episodes, starts):
        assert first not in before[:episode]


def test_starts_at_which_the_ego_would_brake_hard_at_once_are_left_out():
    traffic = replay(*STEADY, *two("close", 30, 7.0, 15.0))
    episodes = traffic.episodes_once(0, IdmParameters())
    assert set(traffic.scenes_of_episodes(0, episodes)) == {"long", "short"}


def test_recordings_in_which_the_ego_always_brakes_hard_at_once_are_refused():
    traffic = replay(*two("close", 30, 7.0, 15.0))
    with pytest.raises(UserError, match=r"harder than 4 m/s2 at once; give other recordings\.$"):
        traffic.episodes_once(0, IdmParameters())


def test_episodes_of_one_recorded_car_are_known_by_its_number():
    traffic = replay(*STEADY)
    episodes = traffic.episodes_once(0, IdmParameters())
    cars = traffic.cars_of_episodes(0, episodes)
    scenes = traffic.scenes_of_episodes(0, episodes)
    assert len(set(zip(cars, scenes))) == len(set(cars)) == 2
