"""Steps from TorchRL's workers: in order, from episodes of their own, with weights that follow the
learner's.

And what the loss of a worker leads to, and what is left of them.
"""

import importlib.util
import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from training import toy
from training.toy import ROAD, ToyRoad, agent, check_order, gone, road, steps

from ganlane import keys
from ganlane.agents import Rainbow, RainbowConfig
from ganlane.build import make_env, make_traffic
from ganlane.settings.traffic import IdmTrafficConfig
from ganlane.settings.train import MultiCollectorConfig, RayCollectorConfig, TrainConfig
from ganlane.errors import UserError
from ganlane.settings.observation import ObservationConfig
from ganlane.training import TrainingConfig, train
from ganlane.training.checkpoint import TrainingState
from ganlane.training.loop import collect
from ganlane.training.phases import identity, make_collector, phases_of
from ganlane.training.workers import (
    EPISODES_PER_WORKER,
    ClusterCollector,
    ProcessCollector,
    WorkerCollector,
    check_reachable,
    noise_seed,
)

ROOT = Path(__file__).resolve().parents[2]
NO_RAY = pytest.mark.skipif(
    importlib.util.find_spec("ray") is None, reason="Ray is not installed (extra ray)"
)
NO_CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")


def pool(workers, num_envs, weights_every):
    return MultiCollectorConfig(num_envs, workers, weights_every)


class Here:
    """TorchRL's collectors of all workers, one after the other in this process, with the interface
    of the others.
    """

    def __init__(self, environments, policies, frames):
        options = {"frames_per_batch": frames // len(policies), "trust_policy": True}
        self.workers = [
            Collector(env, policy_factory=policy, auto_register_policy_transforms=False, **options)
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


# --- steps, episodes, weights


def test_steps_come_in_the_order_of_time_across_batches_and_no_two_workers_drive_the_same_episode():
    seen = steps(HereCollector(road, pool(3, 2, 18)), agent(), 40)
    assert seen.batch_size == (40, 6)
    assert seen["next", "done"].any(0).all()  # every row has driven more than one
    check_order(seen, [w * EPISODES_PER_WORKER + i for w in range(3) for i in range(2)])
    assert keys.VEHICLES not in seen
    assert keys.VEHICLES not in seen["next"]


def test_workers_explore_each_in_its_own_way():
    source = HereCollector(toy.toy, pool(2, 64, 1))
    learner = agent(4, epsilon_start=1.0)
    first, second = source.step(learner)[keys.ACTION].split(64)
    assert not torch.equal(first, second)
    seeds = {noise_seed(0, first) for first in (0, EPISODES_PER_WORKER, 7, EPISODES_PER_WORKER + 7)}
    assert len(seeds | {noise_seed(1, 0)}) == 5


def test_workers_drive_with_the_weights_of_the_last_handover():
    source = HereCollector(toy.toy, pool(2, 4, 32))
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
    source = HereCollector(toy.toy, pool(1, 4, 4))
    run = TrainingState(source, agent(4, epsilon_start=1.0, epsilon=0.0, epsilon_decisions=8))
    for _ in range(3):
        collect(run)
    assert [given[0][1] for given in source.collector.handed_over] == [1.0, 0.5, 0.0]


# --- the loop on top of them


def test_a_run_with_workers_learns_what_a_run_without_does(tmp_path):
    learner = agent(4, **{"gamma": 0.8, "v_min": -10.0, "v_max": 10.0, "learning_rate": 3e-3})
    config = TrainingConfig(6000, log_every=1000, progress=False)
    source = HereCollector(toy.toy, pool(2, 8, 64))
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
    result = train(
        again, resumed, TrainingConfig(480, progress=False), tmp_path, resume=first.checkpoint
    )
    assert "the workers begin the next ones; not bit-exact" in capsys.readouterr().err
    assert again.first_episodes == [int(last) + 1 for last in begun.amax(1)]
    assert len(resumed.replay) > 400  # the buffer of the first stretch is still there
    assert (result.decisions, result.updates > first.updates) == (480, True)


def test_another_number_of_workers_is_refused_on_resume(tmp_path):
    first = train(
        HereCollector(toy.toy, pool(2, 4, 8)),
        agent(4),
        TrainingConfig(80, progress=False),
        tmp_path,
    )
    for other in (HereCollector(toy.toy, pool(3, 4, 8)), ToyRoad(4)):
        with pytest.raises(UserError, match=r"shape \[8\], this run has"):
            train(
                other,
                agent(4),
                TrainingConfig(160, progress=False),
                tmp_path,
                resume=first.checkpoint,
            )


# --- options


def test_a_phase_collects_as_the_option_says():
    collector = MultiCollectorConfig(num_envs=3, workers=5, weights_every=60)
    config = TrainConfig(collector=collector, traffic=IdmTrafficConfig(), env=ROAD)
    (phase,) = phases_of(config, Path("nowhere"))
    source = make_collector(config, phase)
    assert isinstance(source, ProcessCollector)
    assert source.config is collector
    assert collector.environments == source.environments == 15
    assert source.make_env(2, 70).reset()[keys.EPISODE].tolist() == [70, 71]
    assert identity(config, phase)["collector"] == {
        "num_envs": 3,
        "workers": 5,
        "weights_every": 60,
    }


def test_a_missing_ray_is_named_with_the_command_that_mends_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r"pip install 'ganlane\[ray\]'"):
        ClusterCollector(toy.toy, RayCollectorConfig())


@NO_CUDA
def test_on_a_gpu_nothing_of_a_run_is_elsewhere():
    traffic = make_traffic(IdmTrafficConfig(), ROAD)
    env = make_env(traffic, ROAD, ObservationConfig(), num_envs=32, device="cuda")
    learner = Rainbow(RainbowConfig(**toy.SMALL), 29, device="cuda")
    run = TrainingState(env, learner)
    for _ in range(4):
        step = collect(run)
        learner.store(run.window.push(step))
    learner.update()
    tensordicts = (run.collector.env_state, step, learner.replay[:])
    tensors = [value for each in tensordicts for value in each.values(True, True)]
    tensors += [*learner.network.parameters(), *run.stats.sums.values(), run.stats.returns]
    assert {tensor.device.type for tensor in tensors} == {"cuda"}


# --- processes

FIRST = [0, 1, 2**40, 2**40 + 1]


@pytest.mark.slow
def test_a_dead_worker_ends_the_run_in_one_sentence_and_takes_the_others_along():
    learner, threads = agent(), torch.get_num_threads()
    with closing(ProcessCollector(road, pool(2, 2, 8))) as source:
        check_order(steps(source, learner, 4), FIRST)
        numbers = [process.pid for process in source.collector.procs]
        os.kill(numbers[1], signal.SIGKILL)
        with pytest.raises(
            UserError, match=r"^collector=multi: .*died.* go on from the last checkpoint"
        ) as error:
            steps(source, learner, 3)
        assert "\n" not in str(error.value)
    assert not any(Path(f"/proc/{number}").exists() for number in numbers)
    assert torch.get_num_threads() == threads


@pytest.fixture
def carried_along():
    """Ray's workers cannot import the tests: what they need of it travels with them."""
    from ray import cloudpickle

    cloudpickle.register_pickle_by_value(toy)
    yield
    cloudpickle.unregister_pickle_by_value(toy)


@NO_RAY
@pytest.mark.slow
def test_two_ray_workers_collect_and_a_dead_one_is_told_in_one_sentence(carried_along):
    import ray

    learner = agent()
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with closing(ClusterCollector(road, RayCollectorConfig(2, 2, 8))) as source:
        seen = steps(source, learner, 6)
        assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers
        check_order(seen, FIRST)
        assert (
            len(
                {
                    policy.initial_seed()
                    for policy in source.collector.get_distant_attr("policy.generator")
                }
            )
            == 2
        )
        ray.kill(source.collector.remote_collectors[0])
        with pytest.raises(UserError, match=r"^collector=ray: a worker died"):
            steps(source, learner, 4)
    assert not ray.is_initialized()


def test_nobody_at_an_address_is_found_out_at_once():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        check_reachable(f"127.0.0.1:{port}")
        check_reachable(f"ray://127.0.0.1:{port}")
    for address in (f"127.0.0.1:{port}", "ray://127.0.0.1:1", "127.0.0.1:99999"):
        with pytest.raises(ConnectionError):
            check_reachable(address)
    check_reachable("auto")


@NO_RAY
@pytest.mark.slow
def test_an_address_without_a_cluster_is_named(carried_along):
    source = ClusterCollector(road, RayCollectorConfig(1, 1, 1, address="127.0.0.1:1"))
    with (
        closing(source),
        pytest.raises(UserError, match=r"no Ray cluster answers at collector.address=127.0.0.1:1"),
    ):
        source.step(agent())


COMMAND = [
    *("traffic=idm", "init=none", "env.goal_m=40", "collector=multi", "collector.num_envs=8"),
    *("collector.weights_every=32", "log_every=64", "agent.hidden=[16,16]", "agent.batch_size=32"),
    *(
        "agent.warmup=64",
        "agent.capacity=1000",
        "evaluation.agents=[keep_lane]",
        "evaluation.episodes=2",
    ),
]


@pytest.fixture
def start(tmp_path):
    """Start ``ganlane train`` in a folder of its own."""
    options = {"cwd": tmp_path, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    options["env"] = {**os.environ, "PYTHONPATH": str(ROOT)}
    return lambda *given: subprocess.Popen(
        [sys.executable, "-m", "ganlane.train", *given], **options
    )


def wait_for_rows(process, folder, rows):
    """Until ``metrics.csv`` somewhere in ``folder`` has so many."""
    while not any(
        len(path.read_text().splitlines()) > rows for path in folder.rglob("metrics.csv")
    ):
        assert process.poll() is None
        time.sleep(0.02)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_the_whole_group_saves_and_leaves_no_process(number, tmp_path, start):
    process = start(*COMMAND, "total_decisions=1000000000")
    wait_for_rows(process, tmp_path, 1)
    os.killpg(process.pid, number)
    message = process.communicate(timeout=120)[1]
    assert process.returncode == 128 + number
    assert "go on with: ganlane train resume=" in message
    assert "Traceback" not in message
    assert gone(process.pid)


@pytest.mark.slow
def test_a_run_that_lost_a_worker_is_resumed_to_its_end(tmp_path, start):
    process = start(*COMMAND, "total_decisions=4000", "hydra.run.dir=run")
    wait_for_rows(process, tmp_path, 2)
    # Children that run a function of multiprocessing, not its resource tracker.
    children = subprocess.check_output(
        ["ps", "-o", "pid=,args=", "--ppid", str(process.pid)], text=True
    )
    worker = next(line for line in children.splitlines() if "spawn_main" in line)
    os.kill(int(worker.split()[0]), signal.SIGKILL)
    message = process.communicate(timeout=120)[1]
    assert process.returncode == 2
    assert "died" in message
    assert "Traceback" not in message
    again = start("resume=run")
    message = again.communicate()[1]
    assert again.returncode == 0, message
    figures = (tmp_path / "run" / "metrics.csv").read_text()
    assert [int(line.split(",")[0]) for line in figures.splitlines()[1:]][-1] == 3968
    assert json.loads((tmp_path / "run" / "results.json").read_text())["decisions"] == 4000
