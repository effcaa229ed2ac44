"""Checkpoint files: whole, truncated, foreign; parts that are not of the run."""

import pytest
import torch
from reference.refusals import Bomb, user_error
from training.small_runs import agent, road, settings, train

from ganlane.files import seal_archive
from ganlane.training.checkpoint import LAST, TrainingState, load_checkpoint, save_checkpoint


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """The state of a run that has learned."""
    folder = tmp_path_factory.mktemp("stopped")
    train(road(), agent(), settings(160, log_every=72), folder)
    return load_checkpoint(folder / LAST)


#: Places in a state, what stands there instead (`...`: nothing), and what is said of it.
DAMAGE = {
    "agent.network": ({"bias": torch.tensor(torch.nan)}, "numbers of its agent"),
    "agent.optimizer.state.0.exp_avg": (torch.zeros(3), "moments are of other weights"),
    "agent.generators.collect": (torch.zeros(3), "damaged in it"),
    "window.steps.0": ({"action": torch.tensor(torch.inf)}, "numbers of its window"),
    "env_state.batch_size": ([4], "this run has"),
    "stats": (..., "parts of the run are missing"),
    "counters": ([], "damaged in it"),
    "identity": (3, "damaged in it"),
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
    value, told = DAMAGE[place]
    save_checkpoint(tmp_path / "last.pt", with_damage(stopped, place, value))
    with user_error(rf"^resume=[^\n]*last\.pt: [^\n]*{told}[^\n]*\.$"):
        TrainingState(road(), agent()).restore(tmp_path / "last.pt")


def test_the_parts_of_a_run_are_those_of_this_run(stopped, tmp_path):
    save_checkpoint(tmp_path / "last.pt", stopped)
    assert TrainingState(road(), agent()).restore(tmp_path / "last.pt") is None


KIND = "ganlane training checkpoint"


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"weights: none\n",
        3,
        *({"kind": KIND, "version": version, "state": {}} for version in (1, 2)),
        {"kind": KIND, "version": 2, "state": Bomb()},
    ],
    ids=("empty", "text", "number", "old version", "no state", "pickle"),
)
def test_what_is_no_state_of_a_run_is_refused(content, empty_folder):
    path = empty_folder / "last.pt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
        seal_archive(path)
    with user_error(r"^resume=[^\n]*last\.pt"):
        TrainingState(road(), agent()).restore(path)
    assert not (empty_folder / "executed").exists()
