"""A training run behind a mask: its agent knows of it, a resumed run is the same, another mask is another run."""

from pathlib import Path

import entry_tiny
import pytest
import torch

from ganlane.agents import read_agent
from ganlane.build import make_driver
from ganlane.config.command_line import check
from ganlane.config.env import EnvConfig
from ganlane.errors import UserError
from ganlane.parameters.observation import MaskParameters
from ganlane.phases import AGENT_FILE, phases_of, run_phase
from ganlane.training.checkpoints import LAST, load_checkpoint, save_checkpoint

OPTIONS = [*entry_tiny.TINY, "logger.progress=false", "traffic=idm_mobil"]
SAFE = "mask=safe"


def run(folder: Path, *options: str, resume: Path | None = None) -> Path:
    config = check("train", [*OPTIONS, *options]).config
    run_phase(config, phases_of(config, folder)[0], resume)
    return folder


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return read_agent(folder / AGENT_FILE)[0]


def equal(one: Path, other: Path) -> bool:
    first, second = weights(one), weights(other)
    return all(torch.equal(first[name], second[name]) for name in first)


@pytest.fixture(scope="module")
def masked(tmp_path_factory):
    return run(tmp_path_factory.mktemp("masked"), SAFE, "mask.safe_deceleration=3")


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


def test_it_learns_something_else_without_the_mask(masked, tmp_path):
    assert not equal(masked, run(tmp_path, "mask=none"))


def test_a_masked_run_stopped_and_resumed_ends_with_the_same_bits(masked, tmp_path):
    given = [SAFE, "mask.safe_deceleration=3"]
    half = run(tmp_path / "half", *given, "total_decisions=160")
    assert equal(masked, run(half, *given, resume=half / LAST))


@pytest.mark.parametrize("other", ["mask=legal", "mask.safe_deceleration=4"])
def test_a_run_is_not_resumed_behind_another_mask(masked, other):
    with pytest.raises(UserError, match="mask"):
        run(masked, SAFE, "mask.safe_deceleration=3", other, resume=masked / LAST)


def test_runs_without_a_mask_have_the_identity_that_they_always_had(tmp_path):
    """Those of versions that knew no masks can be resumed."""
    assert "mask" not in load_checkpoint(run(tmp_path, "mask=none") / LAST)["identity"]


@pytest.mark.parametrize(("now", "refused"), [([], False), (["env.truck_share=0.5"], True)])
def test_a_run_begun_before_there_was_an_option_goes_on_with_its_default_alone(now, refused, tmp_path):
    half = run(tmp_path, "total_decisions=160")
    state = load_checkpoint(half / LAST)
    del state["identity"]["env"]["truck_share"]
    save_checkpoint(half / LAST, state)
    if refused:
        with pytest.raises(UserError, match="truck_share"):
            run(half, *now, resume=half / LAST)
    else:
        assert run(half, *now, resume=half / LAST)
