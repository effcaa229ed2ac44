"""The paper's Figures 2 and 3.

Which vehicles and which seconds are drawn, and the numbers behind the lines.
"""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from ganlane.errors import UserError
from ganlane.generator.windows import WINDOW_FRAMES, Windows
from ganlane.reproduce.figures import (
    PANELS,
    SAMPLES,
    busiest,
    draw_episode,
    draw_forecasts,
    forecasts_to_draw,
    interesting,
)
from ganlane.view.record import EpisodeLabel, Trajectory

FRAMES = np.arange(WINDOW_FRAMES)


def windows(across):
    """A window per row of ``across`` (y of every frame, m), each of another vehicle at 20 m/s."""
    count = len(across)
    ahead = np.broadcast_to(2.0 * FRAMES, (count, WINDOW_FRAMES))
    number = np.arange(count)
    return Windows(
        positions=np.stack([ahead, np.array(across)], axis=-1),
        scene=np.full(count, "a"),
        start=number,
        vehicle=number,
        lane=number,
        lane_from_left=number,
        length=np.full(count, 4.5),
    )


def test_those_who_start_complete_and_make_no_lane_change_are_told_apart():
    starts, completes = np.clip(FRAMES - 8, 0, None) / 10.0, np.clip(FRAMES, None, 8) / 10.0
    steady, always = 0.001 * FRAMES, FRAMES / 10.0
    chosen = interesting(
        windows(
            [
                *[starts] * 3,
                *[-completes] * 3,
                *[steady] * 2,
                always,
                always,
            ]
        )
    )
    kinds = [kind for kind, count in PANELS.items() for _ in range(count)]
    assert chosen == list(zip(kinds, range(8)))


def test_a_vehicle_that_stands_goes_nowhere():
    standing = windows([0.0 * FRAMES, 0.001 * FRAMES])
    standing.positions[0, :, 0] = 0.0
    assert [row for _, row in interesting(standing)] == [1]


def episode(seconds=20.0, changes_at_s=10.0):
    """Three vehicles; the second one changes lanes, the third is placed elsewhere meanwhile."""
    time_s = np.arange(0.0, seconds, 0.1)
    across = np.clip((time_s - changes_at_s) / 3.0, 0.0, 1.0) * 4.0
    zero = np.zeros_like(time_s)
    ego = 20.0 * time_s
    x = np.stack([ego, ego + 30.0, ego - 20.0 + 300.0 * (time_s > changes_at_s + 1.0)], 1)
    full = np.ones((len(time_s), 3))
    return Trajectory(
        label=EpisodeLabel(),
        time_s=time_s,
        x=x,
        y=np.stack([zero, across, zero + 8.0], 1),
        heading=0.0 * full,
        acceleration=0.0 * full,
        speed=20.0 * full,
        length=4.5 * full,
        width=2.0 * full,
        target_lane=np.zeros((len(time_s), 3), np.int64),
        valid=full > 0,
        action=np.zeros(len(time_s), np.int64),
        returns=zero,
        action_values=full * np.nan,
        reward=zero,
        soft_crash_s=zero[:0],
    )


def test_the_seconds_with_the_lane_change_are_shown_without_vehicles_that_are_placed_elsewhere():
    tracks = busiest(episode())
    assert tracks["vehicle"].unique().to_list() == [0, 1]
    assert (tracks["time_s"].min(), tracks["time_s"].max()) == pytest.approx((10.0, 13.0), abs=0.1)
    assert tracks["x_m"][0] == 0.0


def test_a_short_episode_is_shown_whole():
    assert busiest(episode(seconds=1.0, changes_at_s=0.5))["time_s"].max() == pytest.approx(0.9)


def test_a_body_for_each_of_four_frames_of_every_vehicle_is_drawn():
    axes = draw_episode(EpisodeLabel(), busiest(episode())).axes[0]
    assert len(axes.patches) == 2 * 4
    assert "0 to" not in axes.get_title()


def test_the_predictions_begin_where_the_observed_path_ends():
    try:
        paths = forecasts_to_draw()
    except UserError:
        pytest.skip("the recordings are not at hand")
    now = paths.filter(paths["time_s"] == 0.0)
    assert now["ahead_m"].abs().max() == now["left_m"].abs().max() == 0.0
    assert paths["panel"].n_unique() == 8
    samples = {f"sample {number + 1}" for number in range(SAMPLES)}
    assert set(paths["path"]) == samples | {"observed", "recorded", "mean"}
    at_end = paths.filter(paths["time_s"].is_between(0.75, 0.85) & (paths["kind"] == "goes steady"))
    ahead = dict(at_end.group_by("path").agg(pl.col("ahead_m").mean()).iter_rows())
    assert ahead["mean"] == pytest.approx(ahead["recorded"], rel=0.2)
    assert len(draw_forecasts(paths).axes) == 8
