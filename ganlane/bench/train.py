"""``suite=train``: decisions per second with learning, compared with stable-baselines3's DQN on HighwayEnv."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from ganlane import keys
from ganlane.agents import Rainbow, RainbowConfig
from ganlane.agents.drivers import legal_actions
from ganlane.agents.replay import TRANSITION_KEYS
from ganlane.bench.measure import COLUMNS, EAGER, Case, Group, Row, Runner, Suite, best_rows, speed_table
from ganlane.bench.systems import HighwayEnvRunner, Scenario, highway_env_settings, installed_version
from ganlane.build import make_road
from ganlane.config.commands import BenchConfig
from ganlane.evaluation.table import Table, significant
from ganlane.training import loop
from ganlane.training.checkpoint import TrainingState
from ganlane.transforms import observation_size

SYSTEM = "ganlane training"
_MISSING = (
    "stable-baselines3 or HighwayEnv is not installed, so there is no DQN to compare with; "
    '`pip install "ganlane[bench]"` brings both.'
)
_HEADINGS = (
    *("system", "traffic", "mode", "device", "threads", "environments"),
    *("decisions/s", "physics steps/s", "decisions/CPU-s", "spread"),
)
_BEST = "Each at its best mode, number of threads and number of environments."
#: Priorities set at once.
_CHUNK = 2**16


@dataclass(frozen=True)
class Training:
    """Scenario and agent of a training; ``stored`` transitions are in the buffer when the clock starts."""

    scenario: Scenario
    agent: RainbowConfig
    stored: int


class TrainSuite(Suite):
    """Per device, number of threads and batch all traffics in all modes, in turns with the peer."""

    name = "train"

    def __init__(self, config: BenchConfig) -> None:
        super().__init__(config)
        installed = [installed_version(name) for name in ("stable-baselines3", "highway-env")]
        self.has_peer = config.peers and None not in installed
        if config.peers and not self.has_peer:
            self.notes.append(_MISSING)

    def groups(self) -> list[Group]:
        """One group per device, number of threads and batch."""
        config, agent = self.config, self.config.agent.for_phase(1)
        groups = []
        for device, threads in self.places():
            for batch in config.train_batches:
                cases = []
                for name, traffic in config.chosen_train_traffics().items():
                    training = Training(Scenario.of(config, traffic), agent, config.train_stored)
                    for mode in config.modes:
                        labels = self.labels(SYSTEM, name, mode, threads, batch, device=device)
                        cases.append(Case(labels, partial(start_training, training, mode, device, batch)))
                title = f"{device}, threads {threads}, {batch} environments"
                groups.append(Group(title, threads, cases, baselines_case(self, threads) if self.has_peer else None))
        return groups

    def findings(self, rows: Sequence[Row]) -> dict[str, Any]:
        """``speeds``: the best row of each traffic."""
        return {"speeds": speeds(rows)}

    def tables(self, rows: Sequence[Row], findings: Mapping[str, Any]) -> list[Table]:
        """The best rows, then all."""
        columns = {**COLUMNS, "times the peer": lambda row: significant(row["times_peer"])}
        best = Table.of(
            "Decisions per second with learning",
            findings["speeds"],
            {name: columns[name] for name in (*_HEADINGS[1:7], "times the peer")},
            3,
            [_BEST],
        )
        return [best, speed_table("Training in every mode", rows, _HEADINGS, names=4)]


def speeds(rows: Sequence[Row]) -> list[Row]:
    """Per device and traffic the row with the most decisions per second.

    ``times_peer`` is the ratio of its decisions per second to the peer's best; None without a peer.
    """
    peer = max((row["decisions_per_s"] for row in rows if row["system"] != SYSTEM), default=None)
    best = best_rows([row for row in rows if row["system"] == SYSTEM], "decisions_per_s")
    return [{**row, "times_peer": row["decisions_per_s"] / peer if peer else None} for row in best]


# The training loop


def start_training(training: Training, mode: str, device: str, batch: int) -> Runner:
    """Decisions of ``batch`` environments and the updates that go with them; no logs, no checkpoints."""
    run, _ = filled_run(training, mode, device, batch)
    return with_gradients(partial(advance, run))


def filled_run(training: Training, mode: str, device: str, batch: int) -> tuple[TrainingState, TransformedEnv]:
    """A run that learns from its next decision on, and the environment that it steps.

    Driven transitions are stored until the agent is warm, and the same again until there are ``training.stored``:
    most of a long run has a full buffer, with all of its memory in use.
    """
    env = training.scenario.build(mode, device, batch)
    run = TrainingState(env, make_agent(training, device, mode))
    while not run.agent.ready:
        run.agent.store(run.window.push(loop.collect(run)))
    repeat(run.agent, run.agent.replay[:].select(*TRANSITION_KEYS), training.stored)
    return run, env


def make_agent(training: Training, device: str = "cpu", mode: str = EAGER) -> Rainbow:
    """An agent with random weights, ready to learn as soon as ``stored`` transitions are there."""
    env, config = training.scenario.env, training.agent
    config = replace(config, warmup=min(config.warmup, training.stored))
    size = observation_size(training.scenario.observation.form, env.vehicles)
    legal = partial(legal_actions, road=make_road(env))
    seed = training.scenario.seed
    return Rainbow(config, size, seed=seed, device=device, legal=legal, compile=mode != EAGER)


def repeat(agent: Rainbow, transitions: TensorDict, stored: int) -> None:
    """Store ``transitions`` again and again until there are ``stored``; priorities are uniform in 0 to 1."""
    known = transitions.clone()
    while (missing := stored - len(agent.replay)) > 0:
        agent.store(known[:missing])
    if agent.config.prioritised:
        for index in torch.arange(len(agent.replay), device=agent.device).split(_CHUNK):
            priority = torch.rand(index.shape, generator=agent.generators["replay"], device=agent.device)
            agent.replay.update_priority(index, priority)


def advance(run: TrainingState, decisions: int) -> int:
    """The body of :func:`ganlane.training.train`, so many times; the physics steps simulated, as in a runner."""
    simulated = torch.zeros((), dtype=torch.int64, device=run.agent.device)
    for _ in range(decisions):
        step = loop.advance(run)
        simulated += (step["next", keys.STEP] - step[keys.STEP]).sum()
    return int(simulated)


def with_gradients(run: Runner) -> Runner:
    """``run`` outside the inference mode in which cases are timed."""

    def learning(decisions: int) -> int:
        with torch.inference_mode(False):
            return run(decisions)

    return learning


# stable-baselines3


class BaselinesRunner:
    """stable-baselines3's DQN on ``highway-v0``; its loop can be stopped at any decision.

    ``learn`` itself would end every turn with a whole rollout of ``decisions_per_update``. A batch is in the buffer
    when the clock starts.
    """

    def __init__(self, settings: dict[str, Any], agent: RainbowConfig, seed: int) -> None:
        from stable_baselines3 import DQN

        road = HighwayEnvRunner(settings, seed)
        self.steps_per_decision, self.every, self.pending = road.steps_per_decision, agent.decisions_per_update, 0
        self.model: Any = DQN(
            "MlpPolicy",
            road.env,
            buffer_size=agent.capacity,
            batch_size=agent.batch_size,
            train_freq=agent.decisions_per_update,
            gradient_steps=1,
            exploration_initial_eps=0.05,
            policy_kwargs={"net_arch": list(agent.hidden)},
            seed=seed,
            device="cpu",
        )
        _, self.callback = self.model._setup_learn(10**9)
        self._collect(agent.batch_size)

    def __call__(self, decisions: int) -> int:
        """Collect and learn; see :data:`~ganlane.bench.measure.Runner`."""
        missing = decisions
        while missing:
            taken = min(missing, self.every - self.pending)
            self._collect(taken)
            missing, self.pending = missing - taken, self.pending + taken
            if self.pending == self.every:
                self.model.train(gradient_steps=1, batch_size=self.model.batch_size)
                self.pending = 0
        return decisions * self.steps_per_decision

    def _collect(self, decisions: int) -> None:
        from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

        model, rollout = self.model, TrainFreq(decisions, TrainFrequencyUnit.STEP)
        model.collect_rollouts(model.env, self.callback, rollout, model.replay_buffer, learning_starts=0)


def start_baselines(settings: dict[str, Any], agent: RainbowConfig, seed: int) -> Runner:
    """DQN with the agent's network, batch and rate of updates."""
    with torch.random.fork_rng(devices=[]):
        return with_gradients(BaselinesRunner(settings, agent, seed))


def baselines_case(suite: Suite, threads: int) -> Case:
    """The peer on the suite's road; its network uses torch's threads."""
    config = suite.config
    learner, simulator = installed_version("stable-baselines3"), installed_version("highway-env")
    name = f"stable-baselines3 {learner} DQN on HighwayEnv {simulator}"
    labels = suite.labels(name, "its IDM and MOBIL", EAGER, threads, 1)
    start = partial(start_baselines, highway_env_settings(config.env), config.agent.for_phase(1), config.seed)
    return Case(labels, start)
