"""What a run may start from, and go on from: every experiment fits the agent it names."""

from dataclasses import replace

import pytest

from ganlane.agents import save_agent
from ganlane.config.command_line import check
from ganlane.errors import UserError
from ganlane.paths import conf_folder
from ganlane.phases import AGENT_FILE, check_finished, check_observation, describe, make_agent, phases_of, read_start

EXPERIMENTS = sorted(
    str(path.relative_to(conf_folder() / "experiment").with_suffix(""))
    for path in (conf_folder() / "experiment").rglob("*.yaml")
)


@pytest.mark.parametrize("overrides", [[], *([f"experiment={name}"] for name in EXPERIMENTS)], ids=str)
def test_every_experiment_composes_and_fits_the_agent_that_it_starts_from(overrides):
    config = check("train", overrides).config
    if config.init.path is not None:
        check_observation(read_start(config.init.path), config)


def test_a_first_phase_that_is_over_must_be_the_one_asked_for(tmp_path):
    config = check("train", ["experiment=paper", "pretrain.total_decisions=5000"]).config
    phase = phases_of(config, tmp_path)[0]
    metadata = describe(config, phase)
    metadata["training"] |= {"decisions": 5120}
    save_agent(phase.folder / AGENT_FILE, make_agent(config, phase), metadata)
    check_finished(config, phase)
    with pytest.raises(UserError, match="after 5120 decisions"):
        check_finished(config, replace(phase, total_decisions=9000))
    with pytest.raises(UserError, match="on other traffic"):
        check_finished(config, replace(phase, traffic=config.traffic))


def test_a_falling_learning_rate_has_reached_its_end_when_its_phase_is_over(tmp_path):
    told = ["experiment=paper", "agent.learning_rate_end=1e-5", "pretrain.total_decisions=5000", "total_decisions=90"]
    config = check("train", told).config
    lengths = [make_agent(config, phase).config.learning_rate_decisions for phase in phases_of(config, tmp_path)]
    assert lengths == [5000, 90]
    config.agent = replace(config.agent, learning_rate_decisions=300)
    assert make_agent(config, phases_of(config, tmp_path)[0]).config.learning_rate_decisions == 300
