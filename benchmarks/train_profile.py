"""Where the time of a training run goes, and TorchRL's distributional loss beside the package's
own.

    python -m benchmarks.train_profile
    python -m benchmarks.train_profile --mode compiled --environments 1024 --report
    docs/performance.md

Shares of the time come from timers round the calls of the training loop. The losses are compared on
one network, one batch and one optimiser, in turns as in ``ganlane bench``
(:mod:`ganlane.bench.measure`).
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import date
from functools import partial
from statistics import median
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import TransformedEnv
from torchrl.objectives import DistributionalDQNLoss

from benchmarks.script import ReportSection, add_report, make_parser, run_script
from ganlane.agents import Rainbow, rainbow
from ganlane.bench.measure import EAGER, Case, Runner, take_turns, torch_threads
from ganlane.bench.suites import TrainSuite
from ganlane.bench.systems import Scenario, Training, advance, filled_run, make_agent, repeat
from ganlane.settings.commands import BenchConfig
from ganlane.evaluation import machine_sentence
from ganlane.evaluation.table import Table, count, percent
from ganlane.training.checkpoint import TrainingState

BEGIN, END = "<!-- begin train profile -->", "<!-- end train profile -->"
REST = "rest"
#: Part of the loop to what it consists of; a part without parts is timed itself.
PARTS: dict[str, tuple[str, ...]] = {
    "simulator": (),
    "traffic": (),
    "observation and reward": (),
    "TorchRL's environment": (),
    "policy": (),
    "replay": ("window", "store", "sample", "priorities"),
    "learning": ("compiled update", "loss", "backward", "optimiser", "noise, clipping, target"),
    REST: (),
}
THEIRS, OURS = "TorchRL's DistributionalDQNLoss", "lean loss"
WHOLE_UPDATE = "whole update, with the lean loss"


class Clock:
    """Wall time by part.

    A part that runs inside another one is counted for itself alone, so that all add up.
    """

    def __init__(self, device: str = "cpu") -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._running, self._cuda = [REST], device == "cuda"
        self._since = time.perf_counter()

    def timed(self, function: Callable[..., Any], part: str) -> Callable[..., Any]:
        """``function``, its time counted for ``part``."""

        def call(*arguments: Any, **named: Any) -> Any:
            self._count()
            self._running.append(part)
            try:
                return function(*arguments, **named)
            finally:
                self._count()
                self._running.pop()

        return call

    def shares(self) -> dict[str, float]:
        """Share of each part in the time since the clock was made; they sum to 1."""
        self._count()
        total = sum(self.seconds.values())
        return {part: spent / total for part, spent in self.seconds.items()}

    def _count(self) -> None:
        """The time since the last change belongs to the part that was running."""
        if self._cuda:
            torch.cuda.synchronize()
        now = time.perf_counter()
        self.seconds[self._running[-1]] += now - self._since
        self._since = now


@contextmanager
def instrumented(calls: Sequence[tuple[Any, str, str]], clock: Clock) -> Iterator[None]:
    """Inside, every call ``owner.name()`` of ``calls`` (owner, name, part) is timed."""
    before = [(owner, name, vars(owner).get(name)) for owner, name, _ in calls]
    for owner, name, part in calls:
        # Into the object's own attributes, past what modules do when an attribute is set.
        vars(owner)[name] = clock.timed(getattr(owner, name), part)
    try:
        yield
    finally:
        for owner, name, own in before:
            if own is None:
                del vars(owner)[name]
            else:
                vars(owner)[name] = own


def timed_calls(run: TrainingState, env: TransformedEnv) -> list[tuple[Any, str, str]]:
    """What is timed of a run in ``env``: owner, name, part."""
    agent, replay = run.agent, run.agent.replay
    base, transform = env.base_env, env.transform
    graph = [] if agent.graph is None else [(agent.graph, "_update", "compiled update")]
    return [
        *graph,
        (env, "step_and_maybe_reset", "TorchRL's environment"),
        (base, "_step", "simulator"),
        (base, "_reset", "simulator"),
        (base.traffic, "forward", "traffic"),
        (base.traffic, "init_memory", "traffic"),
        (transform, "_step", "observation and reward"),
        (transform, "_reset", "observation and reward"),
        (agent.policy, "forward", "policy"),
        (run.window, "push", "window"),
        (agent, "store", "store"),
        (agent, "update", "noise, clipping, target"),
        (rainbow, "draw", "sample"),
        (replay.sampler, "update_priority", "priorities"),
        (agent.loss, "forward", "loss"),
        (torch.autograd, "backward", "backward"),
        (agent.optimizer, "step", "optimiser"),
    ]


def take_shares(
    run: TrainingState, env: TransformedEnv, decisions: int, device: str = "cpu"
) -> tuple[dict[str, float], float]:
    """Shares of the parts in ``decisions`` of every environment, and how many all together made per
    second.
    """
    clock, begun = Clock(device), time.perf_counter()
    with instrumented(timed_calls(run, env), clock):
        advance(run, decisions)
    shares = clock.shares()
    return shares, decisions * run.environments / (time.perf_counter() - begun)


def share_table(found: dict[str, tuple[dict[str, float], float]], where: str) -> Table:
    """One column per traffic of ``found`` (shares and decisions/s).

    Parts and, below them, what they consist of.
    """
    lines = []
    for part, details in PARTS.items():
        names = details or (part,)
        lines.append(
            [part, "", *(percent(sum(s.get(n, 0.0) for n in names)) for s, _ in found.values())]
        )
        lines += [
            ["", n, *(percent(shares.get(n, 0.0), 1) for shares, _ in found.values())]
            for n in details
        ]
    rates = "; ".join(
        f"{traffic}: {count(rate)} decisions/s with the timers"
        for traffic, (_, rate) in found.items()
    )
    note = (
        "Wall time with timers round the calls; what one part calls of another is counted with the other. Simulator: "
        f"ego, physics, collisions, first scenes. {where}; {rates}."
    )
    return Table("Share of the time", ["part", "of which", *found], lines, 2, [note])


def start_loss(training: Training, theirs: bool) -> Runner:
    """Loss, backward pass and optimiser step on one batch, without importance weights."""
    agent = make_agent(training)
    batch = random_transitions(agent, training.agent.batch_size)
    forward: Callable[[TensorDictBase], TensorDictBase] = agent.loss
    if theirs:
        forward = partial(DistributionalDQNLoss.forward, agent.loss)

    @torch.inference_mode(False)  # in which cases are timed
    def run(updates: int) -> int:
        for _ in range(updates):
            agent.optimizer.zero_grad(set_to_none=True)
            forward(batch.clone(recurse=False))["loss"].mean().backward()
            agent.optimizer.step()
        return 0

    return run


def start_update(training: Training) -> Runner:
    """:meth:`ganlane.agents.Rainbow.update` with ``training.stored`` transitions in the buffer."""
    agent = make_agent(training)
    repeat(agent, random_transitions(agent, min(training.stored, 10_000)), training.stored)

    @torch.inference_mode(False)  # in which cases are timed
    def run(updates: int) -> int:
        for _ in range(updates):
            agent.update()
        return 0

    return run


def random_transitions(agent: Rainbow, rows: int) -> TensorDict:
    """Transitions as :meth:`ganlane.agents.NStepWindow.push` gives them, with random numbers of a
    usual size.
    """
    generator = torch.Generator().manual_seed(0)
    config = agent.network.config
    observation, following = torch.randn(2, rows, config.observation_size, generator=generator)
    reward = torch.randn(rows, 1, generator=generator)
    terminated = torch.rand(rows, 1, generator=generator) < 0.01
    after = TensorDict(
        {"observation": following, "reward": reward, "terminated": terminated}, [rows]
    )
    content = {
        "observation": observation,
        "action": torch.randint(config.actions, (rows,), generator=generator),
        "steps_to_next_obs": torch.full((rows, 1), float(agent.config.n_step)),
        "next": after,
    }
    return TensorDict(content, [rows])


def compare_losses(
    suite: TrainSuite, training: Training, repetitions: int, seconds: float
) -> Table:
    """Milliseconds per update of both losses and of a whole update, for each of the suite's numbers
    of threads.
    """
    starts: dict[str, Callable[[], Runner]] = {
        THEIRS: partial(start_loss, training, theirs=True),
        OURS: partial(start_loss, training, theirs=False),
        WHOLE_UPDATE: partial(start_update, training),
    }
    lines = []
    for threads in suite.config.threads:
        cases = [
            Case(suite.labels(name, "-", EAGER, threads, 1), start)
            for name, start in starts.items()
        ]
        with torch_threads(threads):
            samples = take_turns(cases, [case.start() for case in cases], repetitions, seconds)
        for name, taken in zip(starts, samples):
            wall, cpu = (
                median(getattr(s, key) / s.decisions for s in taken) for key in ("wall_s", "cpu_s")
            )
            figures = [f"{1000 * wall:.2f}", f"{1000 * cpu:.2f}"]
            lines.append([name, str(threads), str(training.agent.batch_size), *figures])
    note = "The first two: loss, backward pass and optimiser step on the same network and the same batch; eager."
    return Table(
        "Milliseconds per update",
        ["what", "threads", "batch size", "ms", "CPU-ms"],
        lines,
        1,
        [note],
    )


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = make_parser(__doc__)
    parser.add_argument("--traffics", nargs="+", default=["idm_mobil", "gan"])
    parser.add_argument("--mode", choices=("eager", "compiled", "native"), default="compiled")
    parser.add_argument("--environments", type=int, default=1024)
    parser.add_argument(
        "--stored", type=int, default=1_000_000, help="transitions in the buffer from the start"
    )
    parser.add_argument(
        "--decisions", type=int, default=40, help="of every environment, with timers"
    )
    parser.add_argument(
        "--threads", type=int, nargs="+", default=[1, 2], help="the shares use the first one"
    )
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=0.5, help="of a turn")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    add_report(parser, BEGIN, END)
    return parser.parse_args(arguments)


def profile(options: argparse.Namespace) -> str:
    """Measure; the tables, in the document too where one is named."""
    section = ReportSection(options.report, BEGIN, END)
    config = BenchConfig(
        suite="train",
        train_traffics=options.traffics,
        train_batches=[options.environments],
        train_stored=options.stored,
        threads=options.threads,
    )
    agent, found = config.agent.for_phase(1), {}
    for name, traffic in config.chosen_train_traffics().items():
        training = Training(Scenario.of(config, traffic), agent, config.train_stored)
        torch.compiler.reset()
        with torch_threads(config.threads[0]):
            run, env = filled_run(training, options.mode, options.device, options.environments)
            advance(run, 3)  # compilation, caches
            found[name] = take_shares(run, env, options.decisions, options.device)
    where = f"{options.mode}, {options.device}, threads {config.threads[0]}, {options.environments} environments"
    losses = compare_losses(TrainSuite(config), training, options.repetitions, options.seconds)
    taken = f"Taken on {date.today()}: {machine_sentence(config.threads)}"
    text = "\n\n".join([taken, share_table(found, where).markdown(), losses.markdown()])
    section.write(f"\n{text}\n")
    return text


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure; the exit status."""
    return run_script(profile, parse(arguments))


if __name__ == "__main__":
    sys.exit(main())
