"""Phases.

What a run starts from and takes over, what it may go on from, and what its agent is told of it.
"""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import entry_tiny
import pytest
import torch

from ganlane.agents import read_agent, save_agent
from ganlane.build import make_driver
from ganlane.config.run import settings
from ganlane.errors import UserError
from ganlane.files import conf_folder
from ganlane.runtime import has_compiler
from ganlane.settings.env import EnvConfig
from ganlane.settings.observation import MaskParameters
from ganlane.training.checkpoint import (
    LAST,
    load_checkpoint,
    save_checkpoint,
)
from ganlane.training.phases import (
    AGENT_FILE,
    check_observation,
    describe,
    length_if_finished,
    make_agent,
    make_initial_agent,
    phases_of,
    read_start,
    run_phase,
)

ROOT = Path(__file__).resolve().parents[2]
TINY = [*entry_tiny.TINY, "logger.progress=false"]
WITHOUT_INIT = [option for option in entry_tiny.TINY if option != "init=none"]


def run(folder, *options, resume=None):
    """A tiny training, the phase of it that ``folder`` gets."""
    config = settings("train", [*TINY, *options])
    run_phase(config, phases_of(config, folder)[0], resume)
    return folder


def start(folder, path, *options, resume=None):
    """Config and agent of a run in ``folder`` that is to begin from the agent at ``path``."""
    words = [
        *WITHOUT_INIT,
        "init=idm_ckpt",
        f"init.path={path}",
        *options,
    ]
    config = settings("train", words)
    return make_initial_agent(config, phases_of(config, folder)[0], resume)


def equal(one, other):
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def same_agent(one, other):
    """Whether the runs in two folders ended with the same weights."""
    return equal(*(read_agent(folder / AGENT_FILE)[0] for folder in (one, other)))


# --- what a run takes over: weights always, support and moments where asked


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The folder of a finished run."""
    return run(tmp_path_factory.mktemp("runs") / "first")


@pytest.fixture(scope="module")
def last(trained):
    """What its last checkpoint holds of the agent."""
    return load_checkpoint(trained / LAST)["agent"]


@pytest.mark.parametrize("place", ["", str(LAST), AGENT_FILE])
def test_a_run_starts_from_a_folder_a_checkpoint_or_an_agents_file(place, trained, last, tmp_path):
    """This run chose among no agents: the one it left is the last one."""
    _, agent = start(tmp_path, trained / place)
    assert equal(agent.weights(), last["network"])
    assert agent.optimizer.state_dict()["state"] == {}
    assert len(agent.replay) == agent.updates == 0


def test_moments_are_taken_over_where_asked(trained, last, tmp_path):
    _, agent = start(tmp_path, trained, "init.optimizer=true")
    theirs = last["optimizer"]["state"]
    ours = agent.optimizer.state_dict()["state"]
    assert theirs.keys() == ours.keys()
    assert all(equal(theirs[row], ours[row]) for row in theirs)
    assert ours[0]["step"] == last["updates"] > 0
    assert agent.updates == 0


def test_a_run_whose_rate_has_fallen_is_prolonged_at_its_end(tmp_path):
    fall = ["agent.learning_rate_end=1e-5"]
    folder = run(tmp_path, *fall, "total_decisions=160")
    more = [*fall, "total_decisions=320"]
    told = r"agent\.learning_rate_decisions=320: the saved agent has 160"
    with pytest.raises(UserError, match=told):
        run(folder, *more, resume=folder / LAST)
    run(folder, *more, "agent.learning_rate_decisions=160", resume=folder / LAST)
    state = load_checkpoint(folder / LAST)
    assert state["counters"]["decisions"] == 320
    assert state["agent"]["optimizer"]["param_groups"][0]["lr"] == 1e-5


def test_a_file_of_weights_has_no_moments_to_take_over(trained, tmp_path):
    with pytest.raises(
        UserError,
        match=r"agent\.safetensors holds no moments.*last\.pt.*init\.optimizer=false",
    ):
        start(tmp_path, trained / AGENT_FILE, "init.optimizer=true")


OTHER_SUPPORT = [
    "agent.v_min=-50",
    "agent.v_max=60",
    "agent.atoms=21",
]


@pytest.mark.parametrize("place", ["", AGENT_FILE])
def test_another_support_is_refused_unless_the_trained_one_is_asked_for(
    place, trained, last, tmp_path
):
    told = r"give init\.support=trained, set agent\.atoms=101 agent\.v_min=-120"
    with pytest.raises(UserError, match=told):
        start(tmp_path, trained / place, *OTHER_SUPPORT)
    adopted = ["init.support=trained", *OTHER_SUPPORT]
    config, agent = start(tmp_path, trained / place, *adopted)
    for settings_of in (agent.config, config.agent):
        assert (settings_of.atoms, settings_of.v_min, settings_of.v_max) == (101, -120.0, 100.0)
    assert torch.equal(agent.network.support, torch.linspace(-120.0, 100.0, 101))
    assert equal(agent.weights(), last["network"])


def test_a_run_with_an_adopted_support_goes_on_without_what_it_started_from(
    tmp_path,
):
    """And ends as it would have in a piece: here the start lies in a file that is then gone."""
    first = run(tmp_path / "first", "total_decisions=160")
    options = [
        "init=idm_ckpt",
        f"init.path={first}",
        "init.support=trained",
        "init.optimizer=true",
        *OTHER_SUPPORT,
    ]
    whole = run(tmp_path / "whole", *options, "total_decisions=320")
    parts = run(tmp_path / "parts", *options, "total_decisions=160")
    (first / LAST).unlink()
    run(parts, *options, "total_decisions=320", resume=parts / LAST)
    one, network, metadata = read_agent(parts / AGENT_FILE)
    assert equal(one, read_agent(whole / AGENT_FILE)[0])
    assert (network.agent.v_min, network.agent.atoms) == (
        -120.0,
        101,
    )
    assert metadata["agent"]["v_min"] == -120.0


def test_another_observation_is_refused_from_a_checkpoint_too(trained, tmp_path):
    with pytest.raises(UserError, match="give observation=table3_progress or start"):
        start(tmp_path, trained, "observation=table3")
    with pytest.raises(UserError, match=r"give observation\.range_m=200"):
        start(tmp_path, trained, "observation.range_m=100")


#: A checkpoint that can be read, and what of it is no training run's.
DAMAGES = {
    "no state": lambda state: None,
    "no agent": lambda state: {**state, "agent": None},
    "unknown option": lambda state: {
        **state,
        "agent": {**state["agent"], "config": {"wheels": 4}},
    },
    "no observation": lambda state: {**state, "identity": {}},
    "numbers": lambda state: {
        **state,
        "agent": {**state["agent"], "network": {"head.weight": 3}},
    },
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_checkpoint_without_an_agent_is_refused_in_one_sentence(damage, trained, tmp_path):
    save_checkpoint(
        tmp_path / "last.pt",
        DAMAGES[damage](load_checkpoint(trained / LAST)),
    )
    with pytest.raises(
        UserError,
        match=r"^init\.path=.*last\.pt: not a .*checkpoint .*; give ",
    ):
        read_start(str(tmp_path / "last.pt"))


def test_weights_that_are_not_those_of_the_network_are_refused(trained, tmp_path):
    state = load_checkpoint(trained / LAST)
    state["agent"]["network"].popitem()
    save_checkpoint(tmp_path / "last.pt", state)
    with pytest.raises(UserError, match="the weights do not fit the network"):
        start(tmp_path, tmp_path / "last.pt")


@pytest.mark.parametrize("name", ["", "gone.pt"])
def test_a_folder_without_a_checkpoint_is_refused(name, tmp_path):
    with pytest.raises(
        UserError,
        match=r"last\.pt: no such file|gone\.pt: no such file",
    ):
        read_start(str(tmp_path / name))


def test_a_shipped_name_means_the_shipped_agent_beside_a_folder_of_that_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("agent_idm").mkdir()
    assert read_start("agent_idm").moments is None


# --- experiments, lengths, learning rates

EXPERIMENTS = sorted(
    str(path.relative_to(conf_folder() / "experiment").with_suffix(""))
    for path in (conf_folder() / "experiment").rglob("*.yaml")
)


@pytest.mark.parametrize(
    "overrides",
    [[], *([f"experiment={name}"] for name in EXPERIMENTS)],
    ids=str,
)
def test_every_experiment_composes_and_fits_the_agent_that_it_starts_from(
    overrides,
):
    config = settings("train", overrides)
    if config.init.path is not None:
        check_observation(read_start(config.init.path), config.observation)


def test_a_first_phase_that_is_over_must_be_the_one_asked_for(
    tmp_path,
):
    config = settings(
        "train",
        ["experiment=paper", "pretrain.total_decisions=5000"],
    )
    phase = phases_of(config, tmp_path)[0]
    metadata = describe(config, phase)
    metadata["training"] |= {
        "decisions": 5120,
        "updates": 3,
        "wall_s": 1.0,
    }
    save_agent(
        phase.folder / AGENT_FILE,
        make_agent(config, phase),
        metadata,
    )
    assert length_if_finished(config, phase)["decisions"] == 5120
    with pytest.raises(UserError, match="after 5120 decisions"):
        length_if_finished(config, replace(phase, total_decisions=9000))
    with pytest.raises(UserError, match="on other traffic"):
        length_if_finished(config, replace(phase, traffic=config.traffic))


def test_a_falling_learning_rate_has_reached_its_end_when_its_phase_is_over(
    tmp_path,
):
    told = [
        "experiment=paper",
        "agent.learning_rate_end=1e-5",
        "pretrain.total_decisions=5000",
        "total_decisions=90",
    ]
    config = settings("train", told)
    lengths = [
        make_agent(config, phase).config.learning_rate_decisions
        for phase in phases_of(config, tmp_path)
    ]
    assert lengths == [5000, 90]
    config = replace(config, agent=replace(config.agent, learning_rate_decisions=300))
    assert make_agent(config, phases_of(config, tmp_path)[0]).config.learning_rate_decisions == 300


# --- masks

MASKED = [
    "traffic=idm_mobil",
    "mask=safe",
    "mask.safe_deceleration=3",
]


@pytest.fixture(scope="module")
def masked(tmp_path_factory):
    return run(tmp_path_factory.mktemp("masked"), *MASKED)


def test_an_agent_drives_behind_the_mask_that_it_was_trained_with(
    masked,
):
    driver = make_driver(str(masked / AGENT_FILE), EnvConfig())
    assert driver.mask == MaskParameters("safe", 3.0)
    assert make_driver(f"{masked / AGENT_FILE}+safe", EnvConfig()).mask == driver.mask
    assert make_driver(f"{masked / AGENT_FILE}+legal", EnvConfig()).mask == MaskParameters("legal")


def test_the_mask_of_the_next_state_is_kept_with_every_transition(
    masked,
):
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
    with pytest.raises(UserError, match="mask"):
        run(masked, *MASKED, other, resume=masked / LAST)


# --- env.compile=true

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
    run_phase(config, phases_of(config, Path(folder))[0], resume or None)
"""


@pytest.mark.slow
@pytest.mark.skipif(not has_compiler(), reason="no C++ compiler")
def test_a_compiled_run_stopped_and_resumed_in_a_process_of_its_own_ends_with_the_same_bits(
    tmp_path,
):
    """What the compiler leaves is shared by the runs."""
    variables = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "TORCHINDUCTOR_CACHE_DIR": str(tmp_path / "cache"),
        "OMP_NUM_THREADS": "1",
    }
    parts, whole = tmp_path / "parts", tmp_path / "whole"
    for folder, resume, total in ((parts, "", 160), (parts, parts / LAST, 640), (whole, "", 640)):
        words = [*TINY, "env.compile=true", f"total_decisions={total}"]
        line = [sys.executable, "-c", SCRIPT, str(folder), str(resume), *words]
        subprocess.run(line, env=variables, check=True)
    assert same_agent(parts, whole)
