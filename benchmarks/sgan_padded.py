"""A plain Social-GAN that drives: padded scenes, nothing kept, all 8 steps decoded; a baseline for speed.

What somebody writes from the architecture (Gupta et al. 2018) once the loop over scenes is gone: [N, M] vehicles with
a mask, the 8 observed displacements embedded and encoded anew at every step, a layer on the concatenation of relative
position and the other's state for every pair, and a decoder that runs to its end although only its first displacement
is driven. Widths are those of the package's generator, so that the two differ in method and not in size. The weights
are random: they do not change the time.

    python benchmarks/sgan_padded.py --batch 512
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import torch
from torch import Tensor, nn

from ganlane.generator import GeneratorSizes

#: Vehicles start so far apart, m, at this displacement per step, m.
_SPACING_M, _STRIDE_M = 25.0, 2.0


class PaddedGenerator(nn.Module):
    """Encoder, pooling over all pairs of a padded scene, context with noise, decoder."""

    def __init__(self, sizes: GeneratorSizes) -> None:
        super().__init__()
        self.sizes = s = sizes
        self.embed = nn.Linear(2, s.embedding)
        self.encoder = nn.LSTM(s.embedding, s.hidden, batch_first=True)
        self.embed_pair = nn.Linear(2, s.embedding)
        self.pool = nn.Sequential(
            nn.Linear(s.embedding + s.hidden, s.pooling), nn.ReLU(), nn.Linear(s.pooling, s.pooled), nn.ReLU()
        )
        self.context = nn.Sequential(
            nn.Linear(s.hidden + s.pooled, s.context), nn.ReLU(), nn.Linear(s.context, s.hidden - s.noise)
        )
        self.embed_decoded = nn.Linear(2, s.embedding)
        self.decoder = nn.LSTMCell(s.embedding, s.hidden)
        self.head = nn.Linear(s.hidden, 2)

    def forward(self, displacements: Tensor, position: Tensor, valid: Tensor) -> Tensor:
        """Displacements [N * M, 8, 2] that follow [N, M, 8, 2], at positions [N, M, 2], by a mask [N, M]."""
        n, m = valid.shape
        seen = torch.relu(self.embed(displacements)).flatten(0, 1)
        hidden = self.encoder(seen)[1][0][0].view(n, m, -1)
        context = self.context(torch.cat([hidden, self.pooled(hidden, position, valid)], dim=-1))
        noise = torch.randn(n, m, self.sizes.noise)
        return self.decode(torch.cat([context, noise], dim=-1).flatten(0, 1), displacements[..., -1, :].flatten(0, 1))

    def pooled(self, hidden: Tensor, position: Tensor, valid: Tensor) -> Tensor:
        """Max over the others [N, M, P]."""
        m = valid.shape[1]
        relative = torch.relu(self.embed_pair(position[:, None] - position[:, :, None]))
        others = hidden[:, None].expand(-1, m, -1, -1)
        pairs = self.pool(torch.cat([relative, others], dim=-1))
        alone = torch.eye(m, dtype=torch.bool)
        return pairs.masked_fill(~(valid[:, None] & ~alone)[..., None], 0.0).amax(2)

    def decode(self, hidden: Tensor, displacement: Tensor) -> Tensor:
        """All predicted steps."""
        cell, predicted = torch.zeros_like(hidden), []
        for _ in range(self.sizes.predicted):
            hidden, cell = self.decoder(torch.relu(self.embed_decoded(displacement)), (hidden, cell))
            displacement = displacement + self.head(hidden)
            predicted.append(displacement)
        return torch.stack(predicted, dim=1)


#: One physics step: displacements [N, M, 8, 2] and positions [N, M, 2] to the next displacement [N, M, 2].
Predict = Callable[[Tensor, Tensor], Tensor]


class ClosedLoop:
    """Drives ``batch`` scenes of ``vehicles`` by the first displacement that ``predict`` returns.

    No road, no ego, no collisions, no guard: everything that the package does besides is left out.
    """

    def __init__(self, predict: Predict, batch: int, vehicles: int, observed: int) -> None:
        self.predict = predict
        along = torch.arange(vehicles) * _SPACING_M
        self.position = torch.stack([along, torch.zeros(vehicles)], dim=-1).repeat(batch, 1, 1)
        self.displacements = torch.tensor([_STRIDE_M, 0.0]).repeat(batch, vehicles, observed, 1)

    @torch.no_grad()
    def __call__(self, decisions: int) -> int:
        """Ten steps per decision; how many physics steps all scenes together took."""
        for _ in range(10 * decisions):
            # Bounded, for the weights are random.
            step = self.predict(self.displacements, self.position).clamp(-_STRIDE_M, _STRIDE_M)
            self.position = self.position + step
            self.displacements = torch.cat([self.displacements[..., 1:, :], step[..., None, :]], dim=-2)
        return 10 * decisions * self.position.shape[0]


def start(batch: int, vehicles: int, sizes: GeneratorSizes | None = None) -> ClosedLoop:
    """The baseline, ready to run."""
    network = PaddedGenerator(sizes or GeneratorSizes()).requires_grad_(False)
    valid = torch.ones(batch, vehicles, dtype=torch.bool)

    def predict(displacements: Tensor, position: Tensor) -> Tensor:
        return network(displacements, position, valid).view(batch, vehicles, -1, 2)[:, :, 0]

    return ClosedLoop(predict, batch, vehicles, network.sizes.observed)


def report(starter: Callable[[int, int], ClosedLoop]) -> None:
    """Physics steps per second of wall time, for the command line."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--batch", type=int, default=512)
    parser.add_argument("--vehicles", type=int, default=9)
    parser.add_argument("--threads", type=int, default=1)
    asked = parser.parse_args()
    torch.set_num_threads(asked.threads)
    run = starter(asked.batch, asked.vehicles)
    run(1)
    begun = time.perf_counter()
    steps = run(1)
    print(f"{steps / (time.perf_counter() - begun):.0f} physics steps/s")


if __name__ == "__main__":
    report(start)
