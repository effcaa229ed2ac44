"""Where the steps of a phase come from: environments in this process, or in workers."""

from __future__ import annotations

from functools import partial

from torchrl.envs import EnvBase

from ganlane.build import make_env, make_traffic, set_threads
from ganlane.config.train import MultiCollectorConfig, RayCollectorConfig, TrainConfig
from ganlane.memory import keep_freed_memory
from ganlane.phases.phase import Phase
from ganlane.sim.random import Stream
from ganlane.training.collectors import MultiSource, RaySource, SingleSource, Source, Team


def make_source(config: TrainConfig, phase: Phase) -> Source:
    """Where the steps of a phase come from: ``collector=single``, ``multi`` or ``ray``.

    Raises:
        UserError: the environments cannot be made, or Ray is not installed.
    """
    collector = config.collector
    if not isinstance(collector, MultiCollectorConfig):
        return SingleSource(training_env(config, phase, collector.num_envs, device=config.device))
    training_env(config, phase, 1)  # a mistake shows here, before there are workers
    team = Team(collector.workers, collector.num_envs, collector.weights_every)
    if isinstance(collector, RayCollectorConfig):
        return RaySource(partial(worker_env, config, phase), team, collector.address)
    return MultiSource(partial(worker_env, config, phase), team)


def training_env(
    config: TrainConfig, phase: Phase, rows: int, first_episode: int = 0, device: str = "cpu"
) -> EnvBase:
    """``rows`` environments of the training stream; row i begins with episode ``first_episode + i``."""
    traffic = make_traffic(phase.traffic, config.env, Stream.TRAIN)
    return make_env(
        traffic,
        config.env,
        config.observation,
        config.reward,
        rows,
        config.seed,
        device,
        first_episode,
        config.mask,
    )


def worker_env(config: TrainConfig, phase: Phase, rows: int, first_episode: int) -> EnvBase:
    """The same in a process of its own, on its CPU."""
    set_threads(config.threads)
    keep_freed_memory()
    return training_env(config, phase, rows, first_episode)
