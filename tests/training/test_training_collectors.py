"""Steps from workers: in the order of time, from episodes of their own, with weights that follow the learner's."""

import importlib.util
import sys
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from training.toy import ROAD, SMALL, ToyRoad, agent, road, steps, toy

from ganlane import keys
from ganlane.agents import Rainbow, RainbowConfig
from ganlane.build import make_env, make_traffic
from ganlane.config.traffic import IdmTrafficConfig
from ganlane.config.train import MultiCollectorConfig, RayCollectorConfig, TrainConfig
from ganlane.errors import UserError
from ganlane.parameters.observation import ObservationConfig
from ganlane.training import TrainingConfig, train
from ganlane.training.checkpoint import TrainingState
from ganlane.training.loop import collect
from ganlane.training.phases import identity, make_collector, phases_of
from ganlane.training.workers import (
    EPISODES_PER_WORKER,
    ClusterCollector,
    ProcessCollector,
    WorkerCollector,
    noise_seed,
)

ROOT = Path(__file__).resolve().parents[2]
NO_RAY = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed (extra ray)")
NO_CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
QUIET = {"auto_register_policy_transforms": False}


def pool(workers, num_envs, weights_every):
    return MultiCollectorConfig(num_envs, workers, weights_every)


class Here:
    """TorchRL's collectors of all workers, one after the other in this process, with the interface of the others."""

    def __init__(self, environments, policies, frames):
        self.workers = [
            Collector(
                env, policy_factory=policy, frames_per_batch=frames // len(policies), trust_policy=True, **QUIET
            )
            for env, policy in zip(environments, policies)
        ]
        self.handed_over = []

    def map_fn(self, name, arguments):
        self.handed_over.append(arguments)
        for worker, given in zip(self.workers, arguments):
            worker.cascade_execute(name, *given)

    def __iter__(self):
        for batches in zip(*self.workers):
            yield torch.cat(list(batches), 0)

    def shutdown(self):
        for worker in self.workers:
            worker.shutdown()


class HereCollector(WorkerCollector):
    name = "here"

    def start(self, environments, policies, frames):
        return Here(environments, policies, frames)

    def failure(self, error):
        return None


# --- steps, episodes, weights


def test_steps_come_in_the_order_of_time_across_batches():
    source = HereCollector(road, pool(2, 3, 18))
    seen = steps(source, agent(), 10)
    assert seen.batch_size == (10, 6)
    going = ~seen["next", "done"][:-1, :, 0]
    assert going.any()
    assert torch.equal(seen["next", keys.OBSERVATION][:-1][going], seen[keys.OBSERVATION][1:][going])
    assert keys.VEHICLES not in seen
    assert keys.VEHICLES not in seen["next"]


def test_no_two_workers_drive_the_same_episode():
    source = HereCollector(road, pool(3, 2, 60))
    episodes = steps(source, agent(), 40)[keys.EPISODE]
    assert torch.equal(episodes[0], torch.tensor([w * EPISODES_PER_WORKER + i for w in range(3) for i in range(2)]))
    driven = [set(episodes[:, row].tolist()) for row in range(6)]
    assert all(len(own) > 1 for own in driven)
    assert len(set.union(*driven)) == sum(map(len, driven))


def test_workers_explore_each_in_its_own_way():
    source = HereCollector(toy, pool(2, 64, 1))
    learner = agent(4, epsilon_start=1.0)
    first, second = source.step(learner)[keys.ACTION].split(64)
    assert not torch.equal(first, second)
    seeds = {noise_seed(0, first) for first in (0, EPISODES_PER_WORKER, 7, EPISODES_PER_WORKER + 7)}
    assert len(seeds | {noise_seed(1, 0)}) == 5


def test_workers_drive_with_the_weights_of_the_last_handover():
    source = HereCollector(toy, pool(2, 4, 32))
    learner = agent(4, noisy=False, epsilon_start=0.0, epsilon=0.0)
    source.step(learner)
    with torch.no_grad():
        learner.network.head.bias[11:22] += torch.linspace(-50.0, 50.0, 11)
    old = steps(source, learner, 3)[keys.ACTION]
    new = steps(source, learner, 4)[keys.ACTION]
    assert not (old == 0).all()
    assert (new == 0).all()
    assert len(source.collector.handed_over) == 2


@pytest.mark.parametrize(("every", "expected"), [(1, 1), (8, 1), (23, 2), (800, 100)])
def test_weights_are_handed_over_every_so_many_decisions_in_whole_steps(every, expected):
    assert pool(2, 4, every).steps == expected


def test_the_share_of_random_actions_travels_with_the_weights():
    source = HereCollector(toy, pool(1, 4, 4))
    run = TrainingState(source, agent(4, epsilon_start=1.0, epsilon=0.0, epsilon_decisions=8))
    for _ in range(3):
        collect(run)
    assert [given[0][1] for given in source.collector.handed_over] == [1.0, 0.5, 0.0]


# --- the loop on top of them


def test_a_run_with_workers_learns_what_a_run_without_does(tmp_path):
    learner = agent(4, **{"gamma": 0.8, "v_min": -10.0, "v_max": 10.0, "learning_rate": 3e-3})
    config = TrainingConfig(6000, log_every=1000, progress=False)
    source = HereCollector(toy, pool(2, 8, 64))
    result = train(source, learner, config, tmp_path)
    assert result.decisions == 6000
    assert result.updates == pytest.approx((6000 - 32) / 8, abs=8)
    observation = torch.rand(500, 4)
    action = learner.greedy(TensorDict({"observation": observation}, [500]))["action"]
    assert (action == observation[:, :3].argmax(-1)).float().mean() > 0.7


def test_a_resumed_run_begins_the_episodes_after_those_it_had_begun_and_says_so(tmp_path, capsys):
    config = TrainingConfig(400, log_every=200, progress=False)
    source = HereCollector(road, pool(2, 4, 80))
    first = train(source, agent(), config, tmp_path)
    begun = source._last[keys.EPISODE].reshape(2, 4)
    resumed, again = agent(), HereCollector(road, pool(2, 4, 80))
    result = train(again, resumed, TrainingConfig(480, progress=False), tmp_path, resume=first.checkpoint)
    assert "the workers begin the next ones; not bit-exact" in capsys.readouterr().err
    assert again.first_episodes == [int(last) + 1 for last in begun.amax(1)]
    assert len(resumed.replay) > 400  # the buffer of the first stretch is still there
    assert (result.decisions, result.updates > first.updates) == (480, True)


def test_another_number_of_workers_is_refused_on_resume(tmp_path):
    first = train(HereCollector(toy, pool(2, 4, 8)), agent(4), TrainingConfig(80, progress=False), tmp_path)
    for other in (HereCollector(toy, pool(3, 4, 8)), ToyRoad(4)):
        with pytest.raises(UserError, match=r"shape \[8\], this run has"):
            train(other, agent(4), TrainingConfig(160, progress=False), tmp_path, resume=first.checkpoint)


# --- options


def test_a_phase_collects_as_the_option_says(monkeypatch):
    collector = MultiCollectorConfig(num_envs=3, workers=5, weights_every=60)
    config = TrainConfig(collector=collector, traffic=IdmTrafficConfig(), env=ROAD)
    (phase,) = phases_of(config, Path("nowhere"))
    source = make_collector(config, phase)
    assert isinstance(source, ProcessCollector)
    assert source.config is collector
    assert collector.environments == source.environments == 15
    assert source.make_env(2, 70).reset()[keys.EPISODE].tolist() == [70, 71]
    assert identity(config, phase)["collector"] == {"num_envs": 3, "workers": 5, "weights_every": 60}


def test_a_missing_ray_is_named_with_the_command_that_mends_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r"pip install 'ganlane\[ray\]'"):
        ClusterCollector(toy, RayCollectorConfig())


# --- device=cuda


@NO_CUDA
def test_on_a_gpu_nothing_of_a_run_is_elsewhere():
    traffic = make_traffic(IdmTrafficConfig(), ROAD)
    env = make_env(traffic, ROAD, ObservationConfig(), num_envs=32, device="cuda")
    learner = Rainbow(RainbowConfig(**SMALL), 29, device="cuda")
    run = TrainingState(env, learner)
    for _ in range(4):
        step = collect(run)
        learner.store(run.window.push(step))
    learner.update()
    tensors = [
        *run.collector.env_state.values(True, True),
        *step.values(True, True),
        *learner.replay[:].values(True, True),
    ]
    tensors += [*learner.network.parameters(), *run.stats.sums.values(), run.stats.returns]
    assert {tensor.device.type for tensor in tensors} == {"cuda"}
