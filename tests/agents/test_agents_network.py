"""The network: the duel."""

import torch

from ganlane.agents.network import duel


def test_dueling_takes_the_mean_advantage_off():
    rows = torch.tensor([[10.0], [1.0], [2.0], [6.0]])
    assert duel(rows).flatten().tolist() == [8.0, 9.0, 13.0]
