"""What a run takes over from the agent that it starts from: weights always, support and moments where asked."""

from pathlib import Path

import entry_tiny
import pytest
import torch

from ganlane.agents import read_agent
from ganlane.config.command_line import check
from ganlane.config.train import InitConfig, NoInitConfig
from ganlane.errors import UserError
from ganlane.phases import AGENT_FILE, phases_of, read_start, run_phase
from ganlane.phases.agent import begin
from ganlane.training.checkpoints import LAST, load_checkpoint, save_checkpoint

WITHOUT_INIT = [option for option in entry_tiny.TINY if option != "init=none"]
QUIET = ["logger.progress=false"]


def run(folder, *options, resume=None):
    """A tiny training, the phase of it that ``folder`` gets."""
    config = check("train", [*entry_tiny.TINY, *QUIET, *options]).config
    run_phase(config, phases_of(config, folder)[0], resume)
    return folder


def start(folder, path, *options, resume=None):
    """Config and agent of a run in ``folder`` that is about to begin, from the agent at ``path``."""
    given = [*WITHOUT_INIT, "init=idm_ckpt", f"init.path={path}", *options]
    config = check("train", given).config
    return begin(config, phases_of(config, folder)[0], resume)


def equal(one, other):
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


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
    theirs, ours = last["optimizer"]["state"], agent.optimizer.state_dict()["state"]
    assert theirs.keys() == ours.keys()
    assert all(equal(theirs[row], ours[row]) for row in theirs)
    assert ours[0]["step"] == last["updates"] > 0
    assert agent.updates == 0


def test_the_learning_rate_begins_anew(trained, tmp_path):
    fall = ["agent.learning_rate=1e-3", "agent.learning_rate_end=1e-5"]
    source = run(tmp_path / "falling", *fall)
    assert load_checkpoint(source / LAST)["agent"]["optimizer"]["param_groups"][0]["lr"] < 1e-4
    config, agent = start(tmp_path / "next", source, "init.optimizer=true", *fall)
    assert agent.optimizer.param_groups[0]["lr"] == 1e-3
    agent.anneal(config.total_decisions)
    assert agent.optimizer.param_groups[0]["lr"] == 1e-5


def test_a_run_whose_rate_has_fallen_is_prolonged_at_its_end(tmp_path):
    fall = ["agent.learning_rate_end=1e-5"]
    folder = run(tmp_path, *fall, "total_decisions=160")
    with pytest.raises(UserError, match=r"agent\.learning_rate_decisions=320: the saved agent has 160"):
        run(folder, *fall, "total_decisions=320", resume=folder / LAST)
    run(folder, *fall, "agent.learning_rate_decisions=160", "total_decisions=320", resume=folder / LAST)
    state = load_checkpoint(folder / LAST)
    assert state["counters"]["decisions"] == 320
    assert state["agent"]["optimizer"]["param_groups"][0]["lr"] == 1e-5


def test_a_file_of_weights_has_no_moments_to_take_over(trained, tmp_path):
    with pytest.raises(UserError, match=r"agent\.safetensors holds no moments.*last\.pt.*init\.optimizer=false"):
        start(tmp_path, trained / AGENT_FILE, "init.optimizer=true")


def test_a_run_without_an_update_has_no_moments_either(tmp_path):
    idle = run(tmp_path / "idle", "total_decisions=16")
    with pytest.raises(UserError, match="after its first update"):
        start(tmp_path, idle, "init.optimizer=true")


OTHER_SUPPORT = ["agent.v_min=-50", "agent.v_max=60", "agent.atoms=21"]


@pytest.mark.parametrize("place", ["", AGENT_FILE])
def test_another_support_is_refused_unless_the_trained_one_is_asked_for(place, trained, last, tmp_path):
    with pytest.raises(UserError, match=r"give init\.support=trained, set agent\.atoms=101 agent\.v_min=-120"):
        start(tmp_path, trained / place, *OTHER_SUPPORT)
    config, agent = start(tmp_path, trained / place, "init.support=trained", *OTHER_SUPPORT)
    assert (agent.config.atoms, agent.config.v_min, agent.config.v_max) == (101, -120.0, 100.0)
    assert (config.agent.atoms, config.agent.v_min, config.agent.v_max) == (101, -120.0, 100.0)
    assert torch.equal(agent.network.support, torch.linspace(-120.0, 100.0, 101))
    assert equal(agent.weights(), last["network"])


def test_the_same_support_is_adopted_without_effect(trained, tmp_path):
    config, agent = start(tmp_path, trained)
    adopted, same = start(tmp_path, trained, "init.support=trained")
    assert agent.config == same.config
    assert config.agent == adopted.agent


def test_a_run_with_an_adopted_support_goes_on_without_what_it_started_from(tmp_path):
    """And ends as it would have in a piece: here the start lies in a file that is then gone."""
    first = run(tmp_path / "first", "total_decisions=160")
    options = ["init=idm_ckpt", f"init.path={first}", "init.support=trained", "init.optimizer=true", *OTHER_SUPPORT]
    whole = run(tmp_path / "whole", *options, "total_decisions=320")
    parts = run(tmp_path / "parts", *options, "total_decisions=160")
    (first / LAST).unlink()
    run(parts, *options, "total_decisions=320", resume=parts / LAST)
    one, network, metadata = read_agent(parts / AGENT_FILE)
    assert equal(one, read_agent(whole / AGENT_FILE)[0])
    assert (network.v_min, network.atoms) == (-120.0, 101)
    assert metadata["agent"]["v_min"] == -120.0


def test_a_second_phase_begins_with_a_fresh_optimiser(trained, tmp_path):
    given = [*WITHOUT_INIT, "init=idm_ckpt", f"init.path={trained}", "init.optimizer=true"]
    given += ["traffic@pretrain.traffic=idm_mobil", "pretrain.total_decisions=16"]
    config = check("train", given).config
    first, second = phases_of(config, tmp_path)
    assert begin(config, first, None)[1].optimizer.state_dict()["state"]
    run_phase(config, first)
    _, agent = begin(config, second, None)
    assert equal(agent.weights(), read_agent(first.folder / AGENT_FILE)[0])
    assert agent.optimizer.state_dict()["state"] == {}


def test_another_observation_is_refused_from_a_checkpoint_too(trained, tmp_path):
    with pytest.raises(UserError, match="give observation=table3_progress or start"):
        start(tmp_path, trained, "observation=table3")
    with pytest.raises(UserError, match=r"give observation\.range_m=200"):
        start(tmp_path, trained, "observation.range_m=100")


def test_another_number_of_vehicles_is_refused_from_a_checkpoint_too(trained, tmp_path):
    with pytest.raises(UserError, match=r"\[29\].*\[17\]"):
        start(tmp_path, trained, "env.vehicles=5")


def damaged(damage, good: Path, path: Path):
    """A last.pt that is none."""
    state = load_checkpoint(good)
    if damage == "text":
        path.write_text("hello")
    elif damage == "truncated":
        path.write_bytes(good.read_bytes()[:1000])
    elif damage == "another kind":
        torch.save({"kind": "notes"}, path)
    elif damage == "no state":
        save_checkpoint(path, None)
    elif damage == "no agent":
        save_checkpoint(path, {**state, "agent": None})
    elif damage == "unknown option":
        save_checkpoint(path, {**state, "agent": {**state["agent"], "config": {"wheels": 4}}})
    elif damage == "no observation":
        save_checkpoint(path, {**state, "identity": {}})
    else:
        save_checkpoint(path, {**state, "agent": {**state["agent"], "network": {"head.weight": 3}}})


DAMAGES = ["text", "truncated", "another kind", "no state", "no agent", "unknown option", "no observation", "numbers"]


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_refused_in_one_sentence(damage, trained, tmp_path):
    path = tmp_path / "last.pt"
    damaged(damage, trained / LAST, path)
    with pytest.raises(UserError, match=r"^init\.path=.*last\.pt: not a training checkpoint .*; give a run's folder"):
        read_start(str(path))


def test_weights_that_are_not_those_of_the_network_are_refused(trained, tmp_path):
    state, path = load_checkpoint(trained / LAST), tmp_path / "last.pt"
    state["agent"]["network"].popitem()
    save_checkpoint(path, state)
    with pytest.raises(UserError, match="the weights do not fit the network"):
        start(tmp_path, path)


@pytest.mark.parametrize("name", ["", "gone.pt"])
def test_a_folder_without_a_checkpoint_is_refused(name, tmp_path):
    with pytest.raises(UserError, match=r"last\.pt: no such file|gone\.pt: no such file"):
        read_start(str(tmp_path / name))


def test_a_shipped_name_means_the_shipped_agent_beside_a_folder_of_that_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("agent_idm").mkdir()
    assert read_start("agent_idm").moments is None


@pytest.mark.parametrize("kind", [NoInitConfig, lambda **given: InitConfig(path=None, **given)])
@pytest.mark.parametrize("given", [{"optimizer": True}, {"support": "trained"}])
def test_who_starts_afresh_has_nothing_to_take_over(kind, given):
    with pytest.raises(UserError, match=r"of which agent\? give init=idm_ckpt"):
        kind(**given)


def test_another_word_for_the_support_is_refused():
    with pytest.raises(UserError, match=r"init\.support=mine: expected one of run, trained"):
        InitConfig(support="mine")
