"""Phases.

What a run starts from and takes over, what it may go on from, and what its agent is told of it.
"""

from dataclasses import replace

import entry_tiny
import pytest
import torch
from reference import processes
from reference.refusals import user_error

from ganlane.agents import read_agent, save_agent
from ganlane.build import make_driver, reading_of
from ganlane.config.run import settings
from ganlane.files import conf_folder
from ganlane.runtime import has_compiler
from ganlane.settings.env import EnvConfig
from ganlane.settings.observation import MaskParameters
from ganlane.training.checkpoint import LAST, load_checkpoint
from ganlane.training.phases import (
    AGENT_FILE,
    check_observation,
    describe,
    length_if_finished,
    make_agent,
    make_initial_agent,
    phases_of,
    run_phase,
    start_file,
)

TINY = [*entry_tiny.TINY, "logger.progress=false"]
WITHOUT_INIT = [option for option in entry_tiny.TINY if option != "init=none"]


def run(folder, *options, resume=None):
    """A tiny training, the phase of it that ``folder`` gets."""
    config = settings("train", [*TINY, *options])
    run_phase(phases_of(config, folder)[0], resume)
    return folder


def start(folder, path, *options, resume=None):
    """Config and agent of a run in ``folder`` that is to begin from the agent at ``path``."""
    words = [*WITHOUT_INIT, "init=idm_ckpt", f"init.path={path}", *options]
    config = settings("train", words)
    return make_initial_agent(phases_of(config, folder)[0], resume is not None)


def equal(one, other):
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def same_agent(one, other):
    """Whether the runs in two folders ended with the same weights."""
    return equal(*(read_agent(folder / AGENT_FILE)[0] for folder in (one, other)))


# --- what a run takes over: weights alone


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The folder of a finished run."""
    return run(tmp_path_factory.mktemp("runs") / "first")


@pytest.fixture(scope="module")
def last(trained):
    """What its last checkpoint holds of the agent."""
    return load_checkpoint(trained / LAST)["agent"]


@pytest.mark.parametrize("place", ["", AGENT_FILE])
def test_a_run_starts_from_a_folder_or_an_agents_file(place, trained, last, tmp_path):
    """This run chose among no agents: the one it left is the last one."""
    agent = start(tmp_path, trained / place)
    assert equal(agent.weights(), last["network"])
    assert agent.optimizer.state_dict()["state"] == {}
    assert len(agent.replay) == agent.updates == 0


def test_a_run_whose_rate_has_fallen_is_prolonged_at_its_end(tmp_path):
    fall = ["agent.learning_rate_end=1e-5"]
    folder = run(tmp_path, *fall, "total_decisions=160")
    more = [*fall, "total_decisions=320"]
    told = r"agent\.learning_rate_decisions=320: the saved agent has 160"
    with user_error(told):
        run(folder, *more, resume=folder / LAST)
    run(folder, *more, "agent.learning_rate_decisions=160", resume=folder / LAST)
    state = load_checkpoint(folder / LAST)
    assert state["counters"]["decisions"] == 320
    assert state["agent"]["optimizer"]["param_groups"][0]["lr"] == 1e-5


def test_a_run_goes_on_without_what_it_started_from(tmp_path):
    """And ends as it would have in a piece."""
    first = run(tmp_path / "first", "total_decisions=160")
    options = ["init=idm_ckpt", f"init.path={first}"]
    whole = run(tmp_path / "whole", *options, "total_decisions=320")
    parts = run(tmp_path / "parts", *options, "total_decisions=160")
    (first / AGENT_FILE).unlink()
    run(parts, *options, "total_decisions=320", resume=parts / LAST)
    assert same_agent(parts, whole)


def test_another_observation_is_refused_from_a_checkpoint_too(trained, tmp_path):
    with user_error("give observation=table3_progress or start"):
        start(tmp_path, trained, "observation=table3")
    with user_error(r"give observation\.range_m=200"):
        start(tmp_path, trained, "observation.range_m=100")


def test_a_folder_without_an_agent_is_refused(tmp_path):
    with user_error(r"no such file .*agent\.safetensors"):
        read_agent(start_file(str(tmp_path)))


def test_a_shipped_name_means_the_shipped_agent_beside_a_folder_of_that_name(empty_folder):
    (empty_folder / "agent_idm").mkdir()
    assert start_file("agent_idm") == "agent_idm"


# --- experiments, lengths, learning rates

FOLDER = conf_folder() / "experiment"
EXPERIMENTS = sorted(str(path.relative_to(FOLDER))[:-5] for path in FOLDER.rglob("*.yaml"))


@pytest.mark.parametrize("overrides", [[], *([f"experiment={name}"] for name in EXPERIMENTS)])
def test_every_experiment_composes_and_fits_the_agent_that_it_starts_from(overrides):
    config = settings("train", overrides)
    if config.init.path is not None:
        name = start_file(config.init.path)
        trained = reading_of(read_agent(name)[2]).observation
        check_observation(name, trained, config.observation)


def test_a_first_phase_that_is_over_must_be_the_one_asked_for(tmp_path):
    config = settings("train", ["experiment=paper", "pretrain.total_decisions=5000"])
    phase = phases_of(config, tmp_path)[0]
    metadata = describe(phase)
    metadata["training"] |= {"decisions": 5120, "updates": 3, "wall_s": 1.0}
    save_agent(phase.folder / AGENT_FILE, make_agent(phase), metadata)
    assert length_if_finished(phase)["decisions"] == 5120
    others = {
        "after 5120 decisions": {"total_decisions": 9000},
        "on other traffic": {"traffic": config.traffic},
    }
    for told, other in others.items():
        with user_error(told):
            length_if_finished(replace(phase, config=replace(phase.config, **other)))


def test_a_falling_learning_rate_has_reached_its_end_when_its_phase_is_over(tmp_path):
    words = ["experiment=paper", "agent.learning_rate_end=1e-5", "pretrain.total_decisions=5000"]
    for more, lengths in (([], [5000, 90]), (["agent.learning_rate_decisions=300"], [300, 300])):
        phases = phases_of(settings("train", [*words, "total_decisions=90", *more]), tmp_path)
        agents = [make_agent(phase).config for phase in phases]
        assert [agent.learning_rate_decisions for agent in agents] == lengths


# --- masks

MASKED = ["traffic=idm_mobil", "mask=safe", "mask.safe_deceleration=3"]


@pytest.fixture(scope="module")
def masked(tmp_path_factory):
    return run(tmp_path_factory.mktemp("masked"), *MASKED)


def test_an_agent_drives_behind_the_mask_that_it_was_trained_with(masked):
    driver = make_driver(str(masked / AGENT_FILE), EnvConfig())
    assert driver.mask == MaskParameters("safe", 3.0)
    assert make_driver(f"{masked / AGENT_FILE}+safe", EnvConfig()).mask == driver.mask
    assert make_driver(f"{masked / AGENT_FILE}+legal", EnvConfig()).mask == MaskParameters("legal")


def test_the_mask_of_the_next_state_is_kept_with_every_transition(masked):
    rows = load_checkpoint(masked / LAST)["agent"]["replay"]["rows"]
    mask = rows["next.action_mask"]
    assert mask.shape == (len(rows["action"]), 3)
    assert bool(mask[:, 0].all())
    assert not bool(mask[:, 1:].all())


def test_a_masked_run_stopped_and_resumed_ends_with_the_same_bits(masked, tmp_path):
    half = run(tmp_path / "half", *MASKED, "total_decisions=160")
    assert same_agent(masked, run(half, *MASKED, resume=half / LAST))


@pytest.mark.parametrize("other", ["mask=legal", "mask.safe_deceleration=4"])
def test_a_run_is_not_resumed_behind_another_mask(masked, other):
    with user_error("mask"):
        run(masked, *MASKED, other, resume=masked / LAST)


# --- compile=always

#: A phase alone, without the evaluation that a command makes at its end: that would compile as much
#: again.
SCRIPT = """
import sys
from pathlib import Path
from ganlane.config.run import settings
from ganlane.training.phases import phases_of, run_phase

if __name__ == "__main__":
    folder, resume, *told = sys.argv[1:]
    config = settings("train", told)
    run_phase(phases_of(config, Path(folder))[0], resume or None)
"""


@pytest.mark.slow
@pytest.mark.skipif(not has_compiler(), reason="no C++ compiler")
def test_a_compiled_run_stopped_and_resumed_in_a_process_of_its_own_ends_with_the_same_bits(
    tmp_path,
):
    """What the compiler leaves is shared by the runs."""
    cache = {"TORCHINDUCTOR_CACHE_DIR": str(tmp_path / "cache")}
    parts, whole = tmp_path / "parts", tmp_path / "whole"
    for folder, resume, total in ((parts, "", 160), (parts, parts / LAST, 640), (whole, "", 640)):
        words = [*TINY, "compile=always", f"total_decisions={total}"]
        finished = processes.run("-c", SCRIPT, str(folder), str(resume), *words, **cache)
        assert finished.returncode == 0, finished.stderr
    assert same_agent(parts, whole)
