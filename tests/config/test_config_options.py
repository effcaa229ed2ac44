"""Every option composes, is explained, and hands its values on."""

from __future__ import annotations

import dataclasses
import json
import re
from functools import cache
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from ganlane.__main__ import COMMANDS
from ganlane.agents import read_agent
from ganlane.config.command_line import check
from ganlane.config.help import help_text, key_lines
from ganlane.config.schemas import SCHEMAS, option_of, options_of
from ganlane.errors import UserError
from ganlane.files import conf_folder
from ganlane.generator import load_generator, shipped_generator
from ganlane.settings.generator import CalibratedConfig, PaperConfig
from ganlane.settings.observation import (
    FORMS,
    MASKS,
    ObservationConfig,
    RewardParameters,
    SensorParameters,
)
from ganlane.training.phases import describe, phases_of
from ganlane.transforms import OBSERVATIONS

#: Group to a command that has it.
USED_BY = {"data": "train_generator", "generator": "train_generator"}
#: What an option cannot do without.
NEEDS = {
    ("env", "scene"): [f"env.scene.path={Path(__file__).parents[1] / 'reference' / 'scene.csv'}"]
}
OPTIONS = [(group, name) for group in SCHEMAS if group for name in options_of(group)]


@cache
def config_of(command, *overrides):
    """Composed and checked once for all tests, which only look at it."""
    return check(command, list(overrides)).config


@pytest.mark.parametrize("number", range(max(map(len, map(options_of, SCHEMAS)))))
def test_every_option_composes(number):
    """The first of every group together, then the second.

    Experiments are composed in the tests of the phases.
    """
    chosen: dict[str, list[str]] = {"train": [], "train_generator": []}
    for group in filter(None, SCHEMAS):
        option = (names := options_of(group))[number % len(names)]
        chosen[USED_BY.get(group, "train")] += [
            f"{group}={option}",
            *NEEDS.get((group, option), []),
        ]
    for command, overrides in chosen.items():
        config_of(command, *overrides)


@pytest.mark.parametrize(("group", "names"), [("observation", FORMS), ("mask", MASKS)])
def test_every_form_is_an_option_of_its_name(group, names):
    assert set(options_of(group)) == set(names)
    assert all(option_of(group, name)[1] == {"form": name} for name in names)


@pytest.mark.parametrize("group", [group for group in SCHEMAS if group])
def test_every_schema_has_an_option(group):
    assert set(SCHEMAS[group].values()) <= {option_of(group, name)[0] for name in options_of(group)}


@pytest.mark.parametrize("command", COMMANDS)
def test_help_gives_every_key_a_meaning(command):
    missing = re.findall(
        r"^ +[\w]+: [^#\n]+$", help_text(command).partition("keys (KEY=VALUE)")[2], re.MULTILINE
    )
    assert missing == []


@pytest.mark.parametrize(("group", "option"), OPTIONS)
def test_every_key_of_an_option_has_a_meaning(group, option):
    kind, values = option_of(group, option)
    for line in key_lines(kind, values, 0):
        assert "# " in line, line


def test_help_shows_what_an_option_sets():
    shown = "\n".join(key_lines(*option_of("agent", "transfer"), 0))
    assert "learning_rate_end: 2.5e-05" in shown
    assert "n_step: 3" in shown


def test_observation_forms_are_those_of_the_transform():
    assert set(FORMS) == set(OBSERVATIONS)


def test_sensors_are_perfect_unless_an_error_is_asked_for():
    assert config_of("train").observation.sensors is None
    late = config_of("train", "observation=lane_view", "observation.sensors.delay_s=2").observation
    assert late == ObservationConfig(form="lane_view", sensors=SensorParameters(delay_s=2.0))


def test_considerate_is_the_paper_and_a_price_for_danger_behind():
    paper, considerate = (
        config_of("train", f"reward={name}").reward for name in ("paper", "considerate")
    )
    assert dataclasses.asdict(considerate) == {
        **dataclasses.asdict(paper),
        "soft_crash_behind": -10.0,
    }
    assert considerate.soft_crash_behind == considerate.soft_crash
    milder = config_of("evaluate", "reward.soft_crash_behind=-5").reward
    assert milder == RewardParameters(soft_crash_behind=-5.0)
    with pytest.raises(UserError, match=r"reward\.soft_crash_behind=3: expected at most 0"):
        check("train", ["reward=considerate", "reward.soft_crash_behind=3"])


def test_the_reward_stands_in_the_agents_metadata():
    config = config_of("train", "reward=considerate")
    assert (
        describe(config, phases_of(config, Path("run"))[-1])["reward"]["soft_crash_behind"] == -10.0
    )


@pytest.mark.parametrize("name", ["agent_idm", "agent_gan"])
def test_metadata_are_laid_out_as_in_the_agents_of_released_versions(name):
    config = config_of("train")
    now, shipped = describe(config, phases_of(config, Path("run"))[-1]), read_agent(name)[2]
    parts = [part for part in ("env", "agent", "reward", "observation_scale") if part in shipped]
    assert parts
    for part in parts:
        assert flat_types(shipped[part]).items() <= flat_types(now[part]).items(), part


def flat_types(node, prefix=""):
    """Type of each value by its dotted key.

    A whole number may stand for any, and null for anything.
    """
    found = {}
    for key, value in node.items():
        nested = (
            flat_types(value, f"{prefix}{key}.")
            if isinstance(value, dict)
            else {f"{prefix}{key}": kind(value)}
        )
        found.update(nested)
    return found


def kind(value):
    return "number" if type(value) in (int, float) or value is None else type(value).__name__


def test_dqn_switches_every_component_off():
    config = config_of("train", "agent=dqn").agent
    assert not any(
        (config.noisy, config.dueling, config.distributional, config.double, config.prioritised)
    )
    assert config.n_step == 1


def test_dense_traffic_keeps_the_density_for_any_number_of_vehicles():
    few, many = (check("train", ["env=dense", f"env.vehicles={n}"]).config.env for n in (30, 90))
    assert many.spread_m / many.vehicles == pytest.approx(few.spread_m / few.vehicles)
    assert many.spread_m == pytest.approx(3 * few.spread_m)


def test_paper_experiment_is_two_phases_and_can_be_shortened():
    config = check(
        "train", ["experiment=paper", "total_decisions=7", "pretrain.total_decisions=5"]
    ).config
    assert (config.pretrain.traffic.label(), config.traffic.label()) == ("idm_mobil", "gan")
    assert (config.pretrain.total_decisions, config.total_decisions) == (5, 7)
    whole = check("train", ["experiment=paper"]).config
    assert (whole.pretrain.total_decisions, whole.total_decisions) == (10_000_000, 3_000_000)
    assert whole.init.path is None


@pytest.mark.parametrize(
    ("control", "first", "second"), [("gan_only", "gan", "gan"), ("idm_long", None, "idm_mobil")]
)
def test_a_control_differs_from_the_papers_schedule_in_its_traffic_alone(control, first, second):
    paper = check("train", ["experiment=paper" if first else "experiment=paper_gan"]).config
    config = check("train", [f"experiment={control}"]).config
    assert config.traffic.label() == second
    assert (
        config.pretrain.traffic is None
        if first is None
        else config.pretrain.traffic.label() == first
    )
    assert dataclasses.replace(config, traffic=paper.traffic, pretrain=paper.pretrain) == paper
    assert config.pretrain.total_decisions == paper.pretrain.total_decisions


def test_a_generator_file_reaches_every_generated_traffic():
    config = check("evaluate", ["generator.path=mine.safetensors"]).config
    assert {config.traffic_options[name].path for name in ("gan", "gan_calibrated")} == {
        "mine.safetensors"
    }
    assert (
        check("train", ["traffic=gan", "generator.path=mine.safetensors"]).config.traffic.path
        == "mine.safetensors"
    )


def test_yaml_files_explain_themselves():
    for path in conf_folder().rglob("*.yaml"):
        first = next(
            line for line in path.read_text().splitlines() if not line.startswith("# @package")
        )
        assert first.startswith("# "), path
        assert OmegaConf.load(path) is not None


@pytest.mark.parametrize(
    "config", [PaperConfig(), CalibratedConfig()], ids=lambda config: config.preset
)
def test_the_weights_that_ship_were_fitted_with_the_commands_defaults(config):
    preset = config.preset
    shipped = load_generator(shipped_generator(preset), preset)[1]["config"]
    chosen = config_of("train_generator", f"generator={preset}").generator
    assert chosen == config
    assert json.loads(json.dumps(dataclasses.asdict(chosen))) == shipped


@pytest.mark.parametrize("value", ["auto", "always", "never"])
def test_a_training_is_told_whether_to_compile(value):
    config = config_of("train", f"compile={value}")
    assert config.compile == value
    assert config_of("train", "total_decisions=16", f"compile={value}").compiled().env.compile is (
        value == "always"
    )


@pytest.mark.parametrize(("version", "compiles"), [("2.11.0+cu130", False), ("2.13.0+cpu", True)])
def test_a_long_training_is_compiled_where_that_is_known_to_work(version, compiles, monkeypatch):
    monkeypatch.setattr("torch.__version__", version)
    monkeypatch.setattr("ganlane.torch_settings.has_compiler", lambda: True)
    assert config_of("train", "total_decisions=1000000").compiled().env.compile is compiles


@pytest.mark.parametrize(
    "shares", [{"idm": 1}, {"idm": 1, "gan_calibrated": 2}], ids=["fewer", "new"]
)
def test_shares_on_the_command_line_replace_those_of_an_experiment(shares):
    given = ", ".join(f"{name}: {share}" for name, share in shares.items())
    assert (
        config_of("train", "experiment=general", f"traffic.shares={{{given}}}").traffic.shares
        == shares
    )


def test_an_experiment_on_top_of_another_sets_its_own_shares():
    assert config_of("train", "experiment=general_continued").traffic.shares["gan"] == 4


@pytest.mark.parametrize("command", SCHEMAS[""])
def test_the_help_is_plain_text_about_the_command(command):
    text = help_text(command)
    assert ":mod:" not in text
    assert "``" not in text.partition("options (GROUP=NAME")[0]
    assert "Modules" not in text
