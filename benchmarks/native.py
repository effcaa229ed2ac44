"""Physics steps per CPU-second of the native kernel and of the tensor code, one after the other,
several times.

    python benchmarks/native.py
    python benchmarks/native.py --vehicles 9 30 60 --batches 1 16 256 1024 4096 --repeats 5
    python benchmarks/native.py --environment --vehicles 9

Bare physics of ``idm_mobil`` on 3 lanes: no observation, no reward, no resets; the ego keeps its
lane. Printed is the median over the repeats. ``--kernel-only`` leaves the tensor code out,
``--variants`` compares instruction sets.

``--pairs`` adds the tensor code without sorting (:mod:`ganlane.sim.neighbours`).

``--environment``: everything, through TorchRL: observation (``lane_view``), reward and automatic
resets, in episodes of 1 km (about 45 decisions), so that about every 45th row is reset in each
decision. ``--goal-m 5000`` makes them the paper's.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable
from unittest import mock

import torch
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from ganlane import keys
from ganlane.build import make_env
from ganlane.config.env import EnvConfig
from ganlane.env import HighwayEnv
from ganlane.native.library import VARIANTS, best_variant
from ganlane.native.tensors import Kernel
from ganlane.parameters.episode import SpawnParameters
from ganlane.parameters.observation import ObservationConfig
from ganlane.sim import neighbours
from ganlane.sim.state import Road
from ganlane.traffic.idm_mobil import IdmMobilTraffic

STEPS = 10


def steps_per_cpu_second(decide: Callable[[], object], rows: int, least_s: float = 0.1) -> float:
    """Physics steps per second of processor time, all threads together."""
    decisions, start = 0, time.process_time()
    while (used := time.process_time() - start) < least_s:
        decide()
        decisions += 1
    return decisions * rows * STEPS / used


def scene(rows: int, vehicles: int, lanes: int) -> tuple[HighwayEnv, TensorDictBase]:
    """A highway after ten seconds, when lane changes are under way."""
    room = SpawnParameters().min_spacing_m * (vehicles / lanes + 2)
    spawn = SpawnParameters(spread_m=max(200.0, room))
    env = HighwayEnv(
        IdmMobilTraffic(Road(lanes)), num_envs=rows, vehicles=vehicles, spawn_parameters=spawn
    )
    td = env.reset()
    for _ in range(10):
        td[keys.ACTION] = torch.zeros(rows, dtype=torch.int64)
        td = env.step_and_maybe_reset(td)[1]
    td[keys.ACTION] = torch.zeros(rows, dtype=torch.int64)
    return env, td


def contenders(
    env: HighwayEnv, td: TensorDictBase, variants: list[str], tensor: bool, pairs: bool
) -> dict[str, Callable]:
    """Name to a decision of all rows from the same state."""
    made: dict[str, Callable] = {}
    for variant in variants:
        kernel = Kernel(
            env.road, env.vehicles, env.episode, env.ego, mobil=env.traffic.mobil, variant=variant
        )
        made[variant] = lambda kernel=kernel: kernel.decide(td[keys.ACTION], td)
    if tensor:
        made["torch"] = lambda: env._step(td)
    if pairs:

        def by_pairs() -> None:
            with mock.patch.object(neighbours, "SORTS_FROM", math.inf):
                env._step(td)

        made["by pairs"] = by_pairs
    return made


def whole_environments(
    rows: int, vehicles: int, lanes: int, tensor: bool, goal_m: float
) -> dict[str, Callable]:
    """Name to a decision through TorchRL, automatic resets included, of rows in all parts of their
    episodes.
    """
    made: dict[str, Callable] = {}
    room = SpawnParameters().min_spacing_m * (vehicles / lanes + 2)
    for kernel in ("native", "torch") if tensor else ("native",):
        config = EnvConfig(
            vehicles=vehicles, lanes=lanes, spread_m=max(200.0, room), goal_m=goal_m, kernel=kernel
        )
        env = make_env(
            IdmMobilTraffic(Road(lanes)), config, ObservationConfig(form="lane_view"), num_envs=rows
        )
        state = {"td": env.reset()}

        def decide(env: TransformedEnv = env, state: dict[str, TensorDictBase] = state) -> None:
            state["td"][keys.ACTION] = torch.zeros(rows, dtype=torch.int64)
            state["td"] = env.step_and_maybe_reset(state["td"])[1]

        # until the rows are in all parts of their episodes
        for _ in range(round(goal_m / 20.0) + 10):
            decide()
        made[kernel] = decide
    return made


def main() -> None:
    """Print one line per number of vehicles and batch."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vehicles", type=int, nargs="+", default=[9, 30, 60])
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 16, 256, 1024, 4096])
    parser.add_argument("--lanes", type=int, default=3)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--environment", action="store_true")
    parser.add_argument("--goal-m", type=float, default=1000.0)
    parser.add_argument("--kernel-only", action="store_true")
    parser.add_argument("--pairs", action="store_true")
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=[best_variant()])
    wanted = parser.parse_args()
    torch.set_num_threads(wanted.threads)
    print(
        f"{wanted.lanes} lanes, {wanted.threads} threads, torch {torch.__version__}; million steps per CPU-second"
    )
    with torch.inference_mode():
        for vehicles in wanted.vehicles:
            for rows in wanted.batches:
                if wanted.environment:
                    decisions = whole_environments(
                        rows, vehicles, wanted.lanes, not wanted.kernel_only, wanted.goal_m
                    )
                else:
                    env, td = scene(rows, vehicles, wanted.lanes)
                    decisions = contenders(
                        env, td, wanted.variants, not wanted.kernel_only, wanted.pairs
                    )
                rates: dict[str, list[float]] = {name: [] for name in decisions}
                for _ in range(wanted.repeats):
                    for name, decide in decisions.items():
                        rates[name].append(steps_per_cpu_second(decide, rows) / 1e6)
                shown = "  ".join(
                    f"{name} {statistics.median(rate):8.4f}" for name, rate in rates.items()
                )
                print(f"{vehicles:4d} vehicles  batch {rows:5d}  {shown}", flush=True)


if __name__ == "__main__":
    main()
