"""A Social-GAN that drives as the original code does: pooling loops over scenes in Python; a baseline for speed.

Written from the architecture (Gupta et al. 2018): sequences stand time first, the vehicles of all scenes in a long
row with the ends of each scene beside it; encoder and decoder are ``nn.LSTM``, the pooling takes scene by scene and
repeats states and positions for every pair, and the decoder runs all its 8 steps. By default the original pools
after every step of its decoder too (``pool_every_timestep=1``); with ``pool_every_step=False`` it pools once, before
the decoder. Widths are those of the package's generator, so that the two differ in method and not in size (the
original's defaults are several times as wide). The weights are random: they do not change the time.

    python benchmarks/sgan_scene_loop.py --batch 512
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from torch import Tensor, nn

from ganlane.generator import GeneratorSizes

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.sgan_padded import ClosedLoop, report


class SceneLoopGenerator(nn.Module):
    """Encoder, pooling scene by scene, context with noise scene by scene, decoder."""

    def __init__(self, sizes: GeneratorSizes, pool_every_step: bool = True) -> None:
        super().__init__()
        self.sizes, self.pool_every_step = sizes, pool_every_step
        s = sizes
        self.embed = nn.Linear(2, s.embedding)
        self.encoder = nn.LSTM(s.embedding, s.hidden)
        self.embed_pair = nn.Linear(2, s.embedding)
        self.pool = nn.Sequential(
            nn.Linear(s.embedding + s.hidden, s.pooling), nn.ReLU(), nn.Linear(s.pooling, s.pooled), nn.ReLU()
        )
        self.context = nn.Sequential(
            nn.Linear(s.hidden + s.pooled, s.context), nn.ReLU(), nn.Linear(s.context, s.hidden - s.noise), nn.ReLU()
        )
        self.embed_decoded = nn.Linear(2, s.embedding)
        self.decoder = nn.LSTM(s.embedding, s.hidden)
        self.again = nn.Sequential(
            nn.Linear(s.hidden + s.pooled, s.context), nn.ReLU(), nn.Linear(s.context, s.hidden), nn.ReLU()
        )
        self.head = nn.Linear(s.hidden, 2)

    def forward(self, displacements: Tensor, position: Tensor, ends: list[tuple[int, int]]) -> Tensor:
        """Displacements [8, V, 2] after the observed [8, V, 2], at positions [V, 2], with each scene's vehicles."""
        hidden = self.encoder(torch.relu(self.embed(displacements)))[1][0][0]
        context = self.context(torch.cat([hidden, self.pooled(hidden, position, ends)], dim=1))
        return self.decode(self.with_noise(context, ends), displacements[-1], position, ends)

    def pooled(self, hidden: Tensor, position: Tensor, ends: list[tuple[int, int]]) -> Tensor:
        """Max over all of a scene [V, P], one scene after the other."""
        found = []
        for start, end in ends:
            count = end - start
            others = hidden[start:end].repeat(count, 1)
            where = position[start:end]
            relative = where.repeat(count, 1) - where.repeat_interleave(count, dim=0)
            pairs = self.pool(torch.cat([torch.relu(self.embed_pair(relative)), others], dim=1))
            found.append(pairs.view(count, count, -1).max(1)[0])
        return torch.cat(found, dim=0)

    def with_noise(self, context: Tensor, ends: list[tuple[int, int]]) -> Tensor:
        """One latent vector for all of a scene [V, H]."""
        noise = torch.randn(len(ends), self.sizes.noise)
        parts = [
            torch.cat([context[start:end], z.expand(end - start, -1)], dim=1) for (start, end), z in zip(ends, noise)
        ]
        return torch.cat(parts, dim=0)

    def decode(self, hidden: Tensor, displacement: Tensor, position: Tensor, ends: list[tuple[int, int]]) -> Tensor:
        """All predicted steps."""
        state, predicted = (hidden[None], torch.zeros_like(hidden)[None]), []
        for _ in range(self.sizes.predicted):
            output, state = self.decoder(torch.relu(self.embed_decoded(displacement))[None], state)
            displacement = displacement + self.head(output[0])
            predicted.append(displacement)
            if self.pool_every_step:
                position = position + displacement
                pooled = self.pooled(state[0][0], position, ends)
                state = (self.again(torch.cat([state[0][0], pooled], dim=1))[None], state[1])
        return torch.stack(predicted)


def start(batch: int, vehicles: int, sizes: GeneratorSizes | None = None, pool_every_step: bool = True) -> ClosedLoop:
    """The baseline, ready to run."""
    network = SceneLoopGenerator(sizes or GeneratorSizes(), pool_every_step).requires_grad_(False)
    ends = [(vehicles * scene, vehicles * (scene + 1)) for scene in range(batch)]

    def predict(displacements: Tensor, position: Tensor) -> Tensor:
        in_time = displacements.flatten(0, 1).transpose(0, 1).contiguous()
        return network(in_time, position.flatten(0, 1), ends)[0].view(batch, vehicles, 2)

    return ClosedLoop(predict, batch, vehicles, network.sizes.observed)


if __name__ == "__main__":
    report(start)
