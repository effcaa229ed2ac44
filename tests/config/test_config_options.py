"""Every option composes, is explained, and hands its values on."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from ganlane.__main__ import main
from ganlane.config.help import help_text
from ganlane.config.run import COMMANDS, settings
from ganlane.files import conf_folder
from ganlane.settings.generator import CalibratedConfig, PaperConfig
from ganlane.settings.observation import FORMS, MASKS
from ganlane.settings.record import make, option, option_names
from ganlane.settings.traffic import TrafficConfig
from ganlane.transforms import OBSERVATIONS

#: Group to a command that has it.
USED_BY = {"data": "train_generator", "generator": "train_generator", "suite": "benchmark"}
#: What env=scene cannot do without.
SCENE = [f"env.scene.path={Path(__file__).parents[1] / 'reference' / 'scene.csv'}"]
#: Experiments are composed, and trained from their start, in test_training_phases.py.
GROUPS = sorted({path.name for path in conf_folder().iterdir() if path.is_dir()} - {"experiment"})


@cache
def config_of(command, *words):
    """Checked once for all tests, which only look at it."""
    return settings(command, words)


def lines_with_every_option():
    """As few command lines as there can be: each has one option of all groups of its command."""
    for command in ("train", *sorted(set(USED_BY.values()))):
        groups = [group for group in GROUPS if USED_BY.get(group, "train") == command]
        for number in range(max(len(option_names(group)) for group in groups)):
            names = [option_names(group) for group in groups]
            words = [f"{group}={of[number % len(of)]}" for group, of in zip(groups, names)]
            yield [command, *words, *(SCENE if "env=scene" in words else [])]


@pytest.mark.parametrize("line", lines_with_every_option(), ids=" ".join)
def test_every_option_composes(line):
    settings(line[0], line[1:])


@pytest.mark.parametrize(("group", "names"), [("observation", FORMS), ("mask", MASKS)])
def test_every_form_is_an_option_of_its_name(group, names):
    assert set(option_names(group)) == set(names)
    assert all(option(group, name) == {"form": name} for name in names)
    assert set(FORMS) == set(OBSERVATIONS)


def test_every_traffic_is_an_option_under_its_own_name():
    for name in option_names("traffic"):
        assert make(TrafficConfig, name).label() == name
    assert len(TrafficConfig.kinds()) == len(option_names("traffic")) + 1  # and one's own


@pytest.mark.parametrize("command", COMMANDS)
def test_help_is_plain_text_and_gives_every_key_a_meaning(command, capsys):
    text = help_text(command, COMMANDS[command])
    assert main([command, "--help"]) == 0
    assert capsys.readouterr().out == text + "\n"
    keys = text.partition("keys (KEY=VALUE")[2].partition("flags")[0]
    assert re.findall(r"^ +\w+: [^#\n]+$", keys, re.MULTILINE) == []
    assert text.startswith(f"ganlane {command}: ")
    for group in re.findall(r"^  (\w+)$", text.partition("keys (KEY")[0], re.MULTILINE):
        assert all(name in text for name in option_names(group)), group
    assert "seed: 0" in text
    assert "exit status" in text
    assert not re.search(r":\w+:`|``", text)


def test_considerate_is_the_paper_and_a_price_for_danger_behind():
    paper, considerate = (
        config_of("train", f"reward={name}").reward for name in ("paper", "considerate")
    )
    assert considerate == replace(paper, soft_crash_behind=paper.soft_crash)
    assert paper.soft_crash == -10.0
    milder = config_of("evaluate", "reward.soft_crash_behind=-5").reward
    assert milder == replace(paper, soft_crash_behind=-5.0)


def test_dense_traffic_keeps_the_density_for_any_number_of_vehicles():
    few, many = (settings("train", ["env=dense", f"env.vehicles={n}"]).env for n in (30, 90))
    assert many.spread_m / many.vehicles == pytest.approx(few.spread_m / few.vehicles)
    assert many.spread_m == pytest.approx(3 * few.spread_m)


def test_paper_experiment_is_two_phases_and_can_be_shortened():
    whole = settings("train", ["experiment=paper"])
    assert (whole.pretrain.total_decisions, whole.total_decisions) == (10_000_000, 3_000_000)
    assert whole.init.path is None
    shorter = ["experiment=paper", "total_decisions=7", "pretrain.total_decisions=5"]
    short = settings("train", shorter)
    assert (short.pretrain.total_decisions, short.total_decisions) == (5, 7)
    assert (short.pretrain.traffic.label(), short.traffic.label()) == ("idm_mobil", "gan")


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
def test_the_command_fits_with_the_defaults_with_which_the_weights_that_ship_were_fitted(config):
    """That these were is in tests/generator/test_generator_checkpoint.py."""
    assert config_of("train_generator", f"generator={config.preset}").generator == config


@pytest.mark.parametrize("value", ["auto", "always", "never"])
def test_a_training_is_told_whether_to_compile(value):
    short = config_of("train", "total_decisions=16", f"compile={value}")
    assert short.compiles() is (value == "always")


@pytest.mark.parametrize(("version", "compiles"), [("2.11.0+cu130", False), ("2.13.0+cpu", True)])
def test_a_long_training_is_compiled_where_that_is_known_to_work(version, compiles, monkeypatch):
    monkeypatch.setattr("torch.__version__", version)
    monkeypatch.setattr("ganlane.torch_settings.has_compiler", lambda: True)
    assert config_of("train", "total_decisions=1000000").compiles() is compiles


def test_shares_on_the_command_line_replace_those_of_an_experiment():
    words = ["experiment=general", "traffic.shares={idm: 1, gan_calibrated: 2}"]
    assert config_of("train", *words).traffic.shares == {"idm": 1, "gan_calibrated": 2}


def test_an_option_on_the_command_line_replaces_that_of_an_experiment():
    assert config_of("train", "experiment=general").init.path == "agent_gan"
    assert config_of("train", "experiment=general", "init=none").init.path is None
