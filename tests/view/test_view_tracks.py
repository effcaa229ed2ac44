"""Simulated traffic written to a file reads back like recorded traffic."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
import torch
from tensordict.nn import TensorDictModule
from view_scenes import straight

from ganlane.data import read_scenes, scene_lane_widths
from ganlane.data.schema import SCHEMA, TRACK_STRIDE, validate
from ganlane.env import EpisodeParameters, HighwayEnv
from ganlane.errors import UserError
from ganlane.sim.random import Stream
from ganlane.sim.state import Road
from ganlane.traffic.idm_mobil import IdmMobilTraffic
from ganlane.view import EpisodeLabel, record_episode, to_tracks, write_tracks
from ganlane.view.record import scene_names


@pytest.fixture(scope="module")
def episodes():
    """Two simulated episodes of a dozen seconds, in which MOBIL changes lanes."""
    keep = TensorDictModule(lambda step: torch.zeros_like(step), in_keys=["step"], out_keys=["action"])
    env = HighwayEnv(IdmMobilTraffic(Road()), 1, episode=EpisodeParameters(goal_m=200.0), stream=Stream.TRAIN)
    return [record_episode(env, keep, seed=0, episode=number, agent="keep_lane") for number in (0, 1)]


def test_parquet_comes_back_exactly(episodes, tmp_path):
    path = write_tracks(episodes, tmp_path / "simulated.parquet", "parquet")
    read = read_scenes(path)
    assert read.schema == SCHEMA
    assert read["scene"].unique().sort().to_list() == ["keep_lane_traffic_0_0", "keep_lane_traffic_0_1"]
    for episode, (_, scene) in zip(episodes, read.group_by("scene", maintain_order=True)):
        assert scene.equals(to_tracks(episode, scene["scene"][0]))
        one = scene.filter(pl.col("vehicle") == 3)
        assert one["x"].to_numpy() == pytest.approx(episode.x[:, 3])
        assert one["speed"].to_numpy() == pytest.approx(episode.speed[:, 3])


def test_csv_comes_back_through_the_reader_of_recordings(episodes, tmp_path):
    path = write_tracks(episodes, tmp_path / "simulated.csv", "csv")
    read = read_scenes(path)
    exact = read_scenes(write_tracks(episodes, tmp_path / "simulated.parquet", "parquet"))
    same = ["scene", "vehicle", "frame", "x", "speed", "lane", "length", "width"]
    assert read.select(same).equals(exact.select(same))
    # The reader works out the width of the lanes from the positions.
    assert (read["y"] - exact["y"]).abs().max() < 0.05
    assert list(scene_lane_widths(read).values()) == pytest.approx([4.0, 4.0], abs=0.02)


def test_csv_counts_lanes_from_the_left(tmp_path):
    path = write_tracks([straight([0, 30], [0, 2], frames=12)], tmp_path / "a.csv", "csv")
    table = pl.read_csv(path)
    right, left = (table.filter(pl.col("vehicle") == vehicle) for vehicle in (0, 1))
    assert set(right["lane"]) == {3}
    assert set(left["lane"]) == {1}
    assert right["y"].to_numpy() == pytest.approx(np.full(12, -8.0))
    assert left["y"].to_numpy() == pytest.approx(np.zeros(12))
    assert left["v"].to_numpy() == pytest.approx(np.full(12, 20.0))


def test_episodes_that_would_share_a_name_are_numbered():
    labels = [EpisodeLabel("a/agent.safetensors", "idm", 0, 3), EpisodeLabel("b/agent.safetensors", "idm", 0, 3)]
    assert scene_names([*labels, EpisodeLabel("mobil", "idm", 0, 3)]) == [
        "agent_idm_0_3",
        "agent_idm_0_3-2",
        "mobil_idm_0_3",
    ]


def test_what_cannot_be_tracks_leaves_no_file(tmp_path):
    scene = straight([0], [0])
    with pytest.raises(UserError, match="no episode"):
        write_tracks([], tmp_path / "a.csv", "csv")
    with pytest.raises(UserError, match="physics step"):
        write_tracks([replace(scene, time_s=10 * scene.time_s)], tmp_path / "a.parquet", "parquet")
    assert not list(tmp_path.iterdir())


def test_tracks_have_the_form_of_recorded_traffic():
    trajectory = straight([0, 30], [0, 2], frames=12)
    tracks = to_tracks(trajectory, "film")
    assert tracks.schema == SCHEMA
    assert validate(tracks, "film").height == 24
    second = tracks.filter(tracks["vehicle"] == 1)
    assert second["x"].to_list() == pytest.approx(trajectory.x[:, 1].tolist())
    assert second["frame"].to_list() == list(range(12))
    assert set(second["lane"]) == {2}


def test_a_recycled_vehicle_begins_a_new_track_and_padding_is_left_out():
    trajectory = straight([0, 30, 60], [0, 1, 2], frames=12)
    x, valid = trajectory.x.copy(), trajectory.valid.copy()
    x[5:, 1] += 300.0
    valid[:, 2] = False
    tracks = to_tracks(replace(trajectory, x=x, valid=valid))
    assert set(tracks["vehicle"]) == {0, 1, 1 + TRACK_STRIDE}
    assert tracks.filter(tracks["vehicle"] == 1).height == 5
