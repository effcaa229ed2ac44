"""Worker processes: what reaches them, what the loss of one leads to, and what is left of them."""

import functools
import importlib.util
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from training import toy
from training.toy import agent, gone, road, steps

from ganlane import keys
from ganlane.config.train import MultiCollectorConfig, RayCollectorConfig
from ganlane.errors import UserError
from ganlane.training.collectors import shielded_children
from ganlane.training.workers import ClusterCollector, ProcessCollector, check_reachable

ROOT = Path(__file__).resolve().parents[2]
NO_RAY = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed (extra ray)")
QUIET = {"auto_register_policy_transforms": False}


# --- signals


def test_children_of_a_run_are_spared_its_signals():
    with shielded_children():
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            child.send_signal(number)
        time.sleep(0.5)
        assert child.poll() is None
    finally:
        child.kill()
        child.wait()


def test_a_signal_that_comes_while_children_start_is_not_lost_nor_its_handler():
    seen = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: seen.append(number))
    try:
        with shielded_children():
            os.kill(os.getpid(), signal.SIGTERM)
        with shielded_children():
            signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(number))  # as ray.init does
        os.kill(os.getpid(), signal.SIGTERM)
        assert seen == [signal.SIGTERM, signal.SIGTERM]
    finally:
        signal.signal(signal.SIGTERM, before)


# --- processes


def alive(number):
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
def test_a_dead_worker_ends_the_run_in_one_sentence_and_takes_the_others_along():
    source, learner = ProcessCollector(road, MultiCollectorConfig(2, 2, 8)), agent()
    threads = torch.get_num_threads()
    try:
        seen = steps(source, learner, 4)
        assert torch.equal(seen[keys.EPISODE][0], torch.tensor([0, 1, 2**40, 2**40 + 1]))
        going = ~seen["next", "done"][:-1, :, 0]
        assert torch.equal(seen["next", keys.OBSERVATION][:-1][going], seen[keys.OBSERVATION][1:][going])
        numbers = [process.pid for process in source.collector.procs]
        os.kill(numbers[1], signal.SIGKILL)
        with pytest.raises(UserError, match=r"^collector=multi: .*died.* go on from the last checkpoint") as error:
            steps(source, learner, 3)
        assert "\n" not in str(error.value)
    finally:
        source.close()
    assert not any(map(alive, numbers))
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
    source, learner = ClusterCollector(road, RayCollectorConfig(2, 2, 8)), agent()
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    try:
        seen = steps(source, learner, 6)
        assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers
        assert torch.equal(seen[keys.EPISODE][0], torch.tensor([0, 1, 2**40, 2**40 + 1]))
        going = ~seen["next", "done"][:-1, :, 0]
        assert torch.equal(seen["next", keys.OBSERVATION][:-1][going], seen[keys.OBSERVATION][1:][going])
        assert len({policy.initial_seed() for policy in source.collector.get_distant_attr("policy.generator")}) == 2
        import ray

        ray.kill(source.collector.remote_collectors[0])
        with pytest.raises(UserError, match=r"^collector=ray: a worker died"):
            steps(source, learner, 4)
    finally:
        source.close()
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
    with pytest.raises(UserError, match=r"no Ray cluster answers at collector.address=127.0.0.1:1"):
        source.step(agent())
    source.close()


COMMAND = [
    *("traffic=idm", "init=none", "env.goal_m=40", "collector=multi", "collector.num_envs=8"),
    *("collector.weights_every=32", "log_every=64", "agent.hidden=[16,16]", "agent.batch_size=32"),
    *("agent.warmup=64", "agent.capacity=1000", "evaluation.agents=[keep_lane]", "evaluation.episodes=2"),
]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_the_whole_group_saves_and_leaves_no_process(number, tmp_path):
    run = functools.partial(subprocess.Popen, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "ganlane.train", *COMMAND, "total_decisions=1000000000"]
    process = run(command, env=environment)
    while not any(len(path.read_text().splitlines()) > 1 for path in tmp_path.rglob("metrics.csv")):
        assert process.poll() is None
        time.sleep(0.1)
    os.killpg(process.pid, number)
    message = process.communicate(timeout=120)[1]
    assert process.returncode == 128 + number
    assert "go on with: ganlane train resume=" in message
    assert "Traceback" not in message
    assert gone(process.pid)


@pytest.mark.slow
def test_a_run_that_lost_a_worker_is_resumed_to_its_end(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    options = {"cwd": tmp_path, "stderr": subprocess.PIPE, "text": True, "env": environment}
    start = [sys.executable, "-m", "ganlane.train"]
    process = subprocess.Popen([*start, *COMMAND, "total_decisions=4000", "hydra.run.dir=run"], **options)
    figures = tmp_path / "run" / "metrics.csv"
    while not figures.is_file() or len(figures.read_text().splitlines()) < 3:
        assert process.poll() is None
        time.sleep(0.02)
    os.kill(workers_of(process.pid)[0], signal.SIGKILL)
    message = process.communicate(timeout=120)[1]
    assert process.returncode == 2
    assert "died" in message
    assert "Traceback" not in message
    again = subprocess.run([*start, "resume=run"], **options)
    assert again.returncode == 0, again.stderr
    assert [int(line.split(",")[0]) for line in figures.read_text().splitlines()[1:]][-1] == 3968
    assert json.loads((tmp_path / "run" / "results.json").read_text())["decisions"] == 4000


def workers_of(parent: int) -> list[int]:
    """Process ids of a run's workers: children that run a function of multiprocessing, not its resource tracker."""
    found = subprocess.check_output(["ps", "-o", "pid=,args=", "--ppid", str(parent)], text=True)
    return [int(line.split()[0]) for line in found.splitlines() if "spawn_main" in line]
