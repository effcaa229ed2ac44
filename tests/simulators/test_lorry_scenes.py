"""The first scenes of SUMO's traffic: lorries at the net gaps of cars."""

import torch
from reference.worlds import episode_keys

from ganlane.settings.driving import Visibility
from ganlane.sim import Road
from ganlane.sim.spawn import RandomScenes
from ganlane_simulators.sumo import LorryScenes

CARS = RandomScenes(Road(), 9, others_visibility=Visibility.SIGNALLED)


def net_gaps(scene, row):
    """Sorted gaps ahead within each lane of a row, m."""
    x = scene.x[row]
    half = 0.5 * scene.length[row]
    gaps = []
    for lane in range(3):
        there = (scene.target_lane[row] == lane).nonzero()[:, 0]
        order = there[x[there].argsort()]
        gaps.append((x - half)[order[1:]] - (x + half)[order[:-1]])
    return torch.cat(gaps)


def test_so_many_of_the_others_are_lorries_of_twelve_metres_and_the_ego_never_is():
    scene = LorryScenes(CARS, share=0.3)(episode_keys(range(500)), torch.float32)
    lorry = scene.length == 12.0
    assert not lorry[:, 0].any()
    # 4000 draws with probability 0.3: a standard deviation of 0.0072.
    assert abs(lorry[:, 1:].float().mean().item() - 0.3) < 0.03
    assert ((scene.desired_speed[lorry] >= 22.0) & (scene.desired_speed[lorry] <= 25.0)).all()


def test_net_gaps_are_those_of_the_scene_of_cars():
    episodes = episode_keys(range(50))
    cars = CARS(episodes, torch.float64)
    lorries = LorryScenes(CARS, share=0.5)(episodes, torch.float64)
    assert (lorries.length > 4.5).any()
    assert (lorries.x[:, 0] == 0.0).all()
    for row in range(50):
        gaps = net_gaps(lorries, row), net_gaps(cars, row)
        torch.testing.assert_close(*gaps, rtol=0.0, atol=1e-9)
