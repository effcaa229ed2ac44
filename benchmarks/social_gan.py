"""Speed of the generated traffics beside two Social-GANs that were written without this package's
optimisations.

    python -m benchmarks.social_gan
    python -m benchmarks.social_gan --batches 512 2048 --threads 1 2 --report docs/performance.md

Both predict and move, and do nothing else; their widths are those of the package's generator (the
original's defaults are several times as wide), so they differ in method and not in size. Weights
are random: they do not change the time. All take turns as in ``ganlane bench``
(:mod:`ganlane.bench.measure`).
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from datetime import date
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from benchmarks.script import ReportSection, add_report, make_parser, run_script
from ganlane.bench.measure import EAGER, Case, Row, Runner, measure
from ganlane.bench.suites import TRAFFIC, TrafficSuite
from ganlane.settings.commands import BenchConfig
from ganlane.evaluation import machine_sentence
from ganlane.evaluation.table import Table, significant
from ganlane.generator import GeneratorSizes

BEGIN, END = "<!-- begin social gan -->", "<!-- end social gan -->"
#: Vehicles start so far apart, m, at this displacement per step, m.
_SPACING_M, _STRIDE_M = 25.0, 2.0


class PaddedGenerator(nn.Module):
    """The architecture (Gupta et al. 2018) for padded scenes: [N, M] vehicles with a mask.

    All 8 observed displacements are encoded anew at every step, every pair goes through the whole
    first layer of the pooling, and the decoder runs to its end although only its first displacement
    is driven.
    """

    def __init__(self, sizes: GeneratorSizes) -> None:
        super().__init__()
        self.sizes = s = sizes
        self.embed = nn.Linear(2, s.embedding)
        self.encoder = nn.LSTM(s.embedding, s.hidden, batch_first=True)
        self.embed_pair = nn.Linear(2, s.embedding)
        self.pool = _pooling(s)
        self.context = nn.Sequential(
            nn.Linear(s.hidden + s.pooled, s.context),
            nn.ReLU(),
            nn.Linear(s.context, s.hidden - s.noise),
        )
        self.embed_decoded = nn.Linear(2, s.embedding)
        self.decoder = nn.LSTMCell(s.embedding, s.hidden)
        self.head = nn.Linear(s.hidden, 2)

    def forward(self, displacements: Tensor, position: Tensor, valid: Tensor) -> Tensor:
        """Displacements [N * M, 8, 2] that follow [N, M, 8, 2], at positions [N, M, 2], by a mask
        [N, M].
        """
        n, m = valid.shape
        observed = torch.relu(self.embed(displacements)).flatten(0, 1)
        hidden = self.encoder(observed)[1][0][0].view(n, m, -1)
        context = self.context(torch.cat([hidden, self.pooled(hidden, position, valid)], dim=-1))
        noise = torch.randn(n, m, self.sizes.noise)
        return self.decode(
            torch.cat([context, noise], dim=-1).flatten(0, 1),
            displacements[..., -1, :].flatten(0, 1),
        )

    def pooled(self, hidden: Tensor, position: Tensor, valid: Tensor) -> Tensor:
        """Maximum over the others [N, M, P]."""
        m = valid.shape[1]
        relative = torch.relu(self.embed_pair(position[:, None] - position[:, :, None]))
        others = hidden[:, None].expand(-1, m, -1, -1)
        pairs = self.pool(torch.cat([relative, others], dim=-1))
        own = torch.eye(m, dtype=torch.bool)
        return pairs.masked_fill(~(valid[:, None] & ~own)[..., None], 0.0).amax(2)

    def decode(self, hidden: Tensor, displacement: Tensor) -> Tensor:
        """All predicted steps."""
        cell, predicted = torch.zeros_like(hidden), []
        for _ in range(self.sizes.predicted):
            hidden, cell = self.decoder(
                torch.relu(self.embed_decoded(displacement)), (hidden, cell)
            )
            displacement = displacement + self.head(hidden)
            predicted.append(displacement)
        return torch.stack(predicted, dim=1)


class SceneLoopGenerator(nn.Module):
    """The architecture as the original code has it: time first, pooling in a Python loop over
    scenes.

    The vehicles of all scenes are in one long row. The pooling repeats states and positions for
    every pair of a scene, and the decoder runs all its 8 steps. By default the original pools after
    every step of its decoder too (``pool_every_timestep=1``); without ``pool_every_step`` it pools
    once, before the decoder.
    """

    def __init__(self, sizes: GeneratorSizes, pool_every_step: bool = True) -> None:
        super().__init__()
        self.sizes, self.pool_every_step = sizes, pool_every_step
        s = sizes
        self.embed = nn.Linear(2, s.embedding)
        self.encoder = nn.LSTM(s.embedding, s.hidden)
        self.embed_pair = nn.Linear(2, s.embedding)
        self.pool = _pooling(s)
        self.context = nn.Sequential(
            nn.Linear(s.hidden + s.pooled, s.context),
            nn.ReLU(),
            nn.Linear(s.context, s.hidden - s.noise),
            nn.ReLU(),
        )
        self.embed_decoded = nn.Linear(2, s.embedding)
        self.decoder = nn.LSTM(s.embedding, s.hidden)
        self.after_pooling = nn.Sequential(
            nn.Linear(s.hidden + s.pooled, s.context),
            nn.ReLU(),
            nn.Linear(s.context, s.hidden),
            nn.ReLU(),
        )
        self.head = nn.Linear(s.hidden, 2)

    def forward(
        self, displacements: Tensor, position: Tensor, ends: list[tuple[int, int]]
    ) -> Tensor:
        """Displacements [8, V, 2] after the observed [8, V, 2], at positions [V, 2], with each
        scene's vehicles.
        """
        hidden = self.encoder(torch.relu(self.embed(displacements)))[1][0][0]
        context = self.context(torch.cat([hidden, self.pooled(hidden, position, ends)], dim=1))
        return self.decode(self.with_noise(context, ends), displacements[-1], position, ends)

    def pooled(self, hidden: Tensor, position: Tensor, ends: list[tuple[int, int]]) -> Tensor:
        """Maximum over all of a scene [V, P], one scene after the other."""
        found = []
        for start, end in ends:
            vehicles = end - start
            others = hidden[start:end].repeat(vehicles, 1)
            place = position[start:end]
            relative = place.repeat(vehicles, 1) - place.repeat_interleave(vehicles, dim=0)
            pairs = self.pool(torch.cat([torch.relu(self.embed_pair(relative)), others], dim=1))
            found.append(pairs.view(vehicles, vehicles, -1).max(1)[0])
        return torch.cat(found, dim=0)

    def with_noise(self, context: Tensor, ends: list[tuple[int, int]]) -> Tensor:
        """One latent vector for all of a scene [V, H]."""
        noise = torch.randn(len(ends), self.sizes.noise)
        parts = [
            torch.cat([context[start:end], z.expand(end - start, -1)], dim=1)
            for (start, end), z in zip(ends, noise)
        ]
        return torch.cat(parts, dim=0)

    def decode(
        self, hidden: Tensor, displacement: Tensor, position: Tensor, ends: list[tuple[int, int]]
    ) -> Tensor:
        """All predicted steps."""
        state, predicted = (hidden[None], torch.zeros_like(hidden)[None]), []
        for _ in range(self.sizes.predicted):
            output, state = self.decoder(torch.relu(self.embed_decoded(displacement))[None], state)
            displacement = displacement + self.head(output[0])
            predicted.append(displacement)
            if self.pool_every_step:
                position = position + displacement
                pooled = self.pooled(state[0][0], position, ends)
                state = (
                    self.after_pooling(torch.cat([state[0][0], pooled], dim=1))[None],
                    state[1],
                )
        return torch.stack(predicted)


def _pooling(s: GeneratorSizes) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(s.embedding + s.hidden, s.pooling),
        nn.ReLU(),
        nn.Linear(s.pooling, s.pooled),
        nn.ReLU(),
    )


class ClosedLoop:
    """Drives ``batch`` scenes of ``vehicles`` by the first displacement that ``predict`` returns.

    No road, no ego, no collisions, no guard.

    Args:
        predict: displacements [N, M, 8, 2] and positions [N, M, 2] to the next displacement [N, M,
            2].
        batch, vehicles: N and M.
        observed: 8, the displacements that are observed.
    """

    def __init__(
        self,
        predict: Callable[[Tensor, Tensor], Tensor],
        batch: int,
        vehicles: int,
        observed: int = 8,
    ) -> None:
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
            self.displacements = torch.cat(
                [self.displacements[..., 1:, :], step[..., None, :]], dim=-2
            )
        return 10 * decisions * self.position.shape[0]


def start_padded(batch: int, vehicles: int) -> ClosedLoop:
    """The padded baseline, ready to run."""
    network = PaddedGenerator(GeneratorSizes()).requires_grad_(False)
    valid = torch.ones(batch, vehicles, dtype=torch.bool)

    def predict(displacements: Tensor, position: Tensor) -> Tensor:
        return network(displacements, position, valid).view(batch, vehicles, -1, 2)[:, :, 0]

    return ClosedLoop(predict, batch, vehicles)


def start_scene_loop(batch: int, vehicles: int, pool_every_step: bool = True) -> ClosedLoop:
    """The baseline that loops over scenes, ready to run."""
    network = SceneLoopGenerator(GeneratorSizes(), pool_every_step).requires_grad_(False)
    ends = [(vehicles * scene, vehicles * (scene + 1)) for scene in range(batch)]

    def predict(displacements: Tensor, position: Tensor) -> Tensor:
        in_time = displacements.flatten(0, 1).transpose(0, 1).contiguous()
        return network(in_time, position.flatten(0, 1), ends)[0].view(batch, vehicles, 2)

    return ClosedLoop(predict, batch, vehicles)


BASELINES: dict[str, Callable[[int, int], ClosedLoop]] = {
    "scene loop, pooling at every step": start_scene_loop,
    "scene loop, pooling once": partial(start_scene_loop, pool_every_step=False),
    "padded, 8 steps decoded": start_padded,
}


def start_seeded(name: str, batch: int, vehicles: int) -> Runner:
    """One of :data:`BASELINES`; the weights are the same in every run."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return BASELINES[name](batch, vehicles)


class SocialGanSuite(TrafficSuite):
    """``suite=traffic`` with the baselines in every group."""

    def cases(self, threads: int, batch: int) -> list[Case]:
        """Traffics, then baselines."""
        baselines = [
            Case(
                self.labels(name, "Social-GAN", EAGER, threads, batch),
                partial(start_seeded, name, batch, self.config.env.vehicles),
            )
            for name in BASELINES
        ]
        return [*super().cases(threads, batch), *baselines]

    def findings(self, rows: Sequence[Row]) -> dict[str, Any]:
        """``ratios`` of each traffic to each baseline."""
        return {"ratios": ratios(rows)}

    def tables(self, rows: Sequence[Row], findings: Mapping[str, Any]) -> list[Table]:
        """All rows, then the ratios."""
        columns = {
            "traffic": lambda row: row["traffic"],
            "baseline": lambda row: row["baseline"],
            "times the baseline": lambda row: significant(row["ratio"]),
            "in CPU time": lambda row: significant(row["ratio_cpu"]),
        }
        note = "Both at their best mode, batch and number of threads, for wall time and for CPU time each."
        ratio_table = Table.of("Against plain Social-GANs", findings["ratios"], columns, 2, [note])
        return [*super().tables(rows, findings), ratio_table]


def ratios(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Of each traffic to each baseline, both at their best: ``ratio`` (wall time) and
    ``ratio_cpu``.

    The two ratios may come from different rows: one thread gives the most for its CPU time.
    """

    def ratio(rate: str, traffic: str, baseline: str) -> float:
        ours = max(
            row[rate] for row in rows if (row["system"], row["traffic"]) == (TRAFFIC, traffic)
        )
        return ours / max(row[rate] for row in rows if row["system"] == baseline)

    return [
        {
            "traffic": traffic,
            "baseline": baseline,
            "ratio": ratio("physics_steps_per_s", traffic, baseline),
            "ratio_cpu": ratio("physics_steps_per_cpu_s", traffic, baseline),
        }
        for traffic in dict.fromkeys(row["traffic"] for row in rows if row["system"] == TRAFFIC)
        for baseline in BASELINES
    ]


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = make_parser(__doc__)
    parser.add_argument("--traffics", nargs="+", default=["gan", "gan_calibrated"])
    parser.add_argument("--batches", type=int, nargs="+", default=[512, 2048])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--modes", nargs="+", default=["eager", "compiled"])
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=0.5, help="of a turn")
    add_report(parser, BEGIN, END)
    return parser.parse_args(arguments)


def compare(options: argparse.Namespace) -> str:
    """Measure all; the tables, in the document too where one is named."""
    section = ReportSection(options.report, BEGIN, END)
    config = BenchConfig(
        suite="traffic",
        traffics=options.traffics,
        traffic_batches=options.batches,
        threads=options.threads,
        modes=options.modes,
    )
    suite = SocialGanSuite(config)
    numbers = measure(suite, options.repetitions, options.seconds)
    tables = [table.markdown() for table in suite.tables(numbers["rows"], numbers)]
    taken = f"Taken on {date.today()}: {machine_sentence(options.threads)}"
    text = "\n\n".join([taken, *tables, *numbers["notes"]])
    section.write(f"\n{text}\n")
    return text


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure; the exit status."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    return run_script(compare, parse(arguments))


if __name__ == "__main__":
    sys.exit(main())
