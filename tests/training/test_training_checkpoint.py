"""Checkpoint files: whole, truncated, foreign; parts that are not of the run."""

import pytest
import torch
from reference.refusals import Bomb
from training.small_runs import agent, road, settings, train

from ganlane.errors import UserError
from ganlane.files import seal_archive
from ganlane.training.checkpoint import (
    LAST,
    TrainingState,
    load_checkpoint,
    save_checkpoint,
)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("part", ["network", "target", "optimizer"])
def test_weights_that_are_not_finite_are_refused(part, value, tmp_path):
    state = {"agent": {part: {"state": {0: {"exp_avg": torch.tensor([1.0, value])}}}}}
    save_checkpoint(tmp_path / "last.pt", state)
    with pytest.raises(UserError, match=f"numbers of its {part} are not finite"):
        load_checkpoint(tmp_path / "last.pt")


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """The state of a run that has learned."""
    folder = tmp_path_factory.mktemp("stopped")
    train(road(8), agent(), settings(160, log_every=72), folder)
    return load_checkpoint(folder / LAST)


#: Places in a state, and what stands there instead (`...`: nothing).
DAMAGE = {
    "agent.optimizer.state.0.exp_avg": torch.zeros(3),  # the optimiser would write beyond it
    "agent.optimizer.state": {0: {}},
    "agent.generators.collect": torch.zeros(3),
    "agent.updates": "many",
    "agent.replay.cursor": 10**30,
    "agent.replay.rows": {},
    "agent.replay.rows.action": torch.full((144,), 3),
    "agent.replay.rows.observation": torch.zeros(144, 1),
    "agent.replay.rows.steps_to_next_obs": torch.full((144, 1), -1e30),
    "agent.replay.sampler.priorities": torch.zeros(3, 64),
    "agent.replay.sampler.beta": "x",
    "window.steps.0": {"action": 3},
    "window.steps.1.following_mask": 2.5,
    "env_state.items.episode": ...,
    "env_state.items.events": None,
    "env_state.batch_size": "x",
    "stats.running.values": torch.zeros(8, dtype=torch.int64),
    "stats.update_count": 0,
    "stats.sums": [],
    "counters.decisions": 2.5,
    "counters.best": float("nan"),
    "counters": [],
    "identity": 3,
}


def with_damage(state, place, value):
    name, _, below = place.partition(".")
    name = int(name) if name.isdigit() else name
    changed = dict(enumerate(state)) if isinstance(state, list) else dict(state)
    changed[name] = with_damage(changed[name], below, value) if below else value
    left = {key: part for key, part in changed.items() if part is not ...}
    return list(left.values()) if isinstance(state, list) else left


@pytest.mark.parametrize("place", DAMAGE)
def test_a_part_of_a_run_that_is_something_else_is_refused_in_one_sentence(
    place, stopped, tmp_path
):
    save_checkpoint(
        tmp_path / "last.pt",
        with_damage(stopped, place, DAMAGE[place]),
    )
    with pytest.raises(
        UserError,
        match=r"^resume=[^\n]*last\.pt: [^\n]*; give another checkpoint\.$",
    ):
        TrainingState(road(8), agent()).restore(tmp_path / "last.pt")


def test_the_parts_of_a_run_are_those_of_this_run(stopped, tmp_path):
    save_checkpoint(tmp_path / "last.pt", stopped)
    assert TrainingState(road(8), agent()).restore(tmp_path / "last.pt") is None


KIND = "ganlane training checkpoint"


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"weights: none\n",
        3,
        {"kind": KIND, "version": 1, "state": {}},
        {"kind": KIND, "version": 2, "state": {}},
        {"kind": KIND, "version": 2, "state": Bomb()},
    ],
    ids=("empty", "text", "number", "old version", "no state", "pickle"),
)
def test_what_is_no_state_of_a_run_is_refused(content, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "last.pt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
        seal_archive(path)
    with pytest.raises(UserError, match=r"^resume=[^\n]*last\.pt"):
        TrainingState(road(8), agent()).restore(path)
    assert not (tmp_path / "executed").exists()
