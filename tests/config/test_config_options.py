"""Every option composes, says in its YAML what its dataclass says, and knows every key of what it configures."""

from __future__ import annotations

import dataclasses
import json
from functools import cache
from pathlib import Path

import pytest
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from ganlane.__main__ import COMMANDS
from ganlane.agents import read_agent
from ganlane.config.compose import check
from ganlane.config.data import NgsimDataConfig
from ganlane.config.generator import (
    CalibratedGeneratorConfig,
    CalibratedLoopOptions,
    LoopOptions,
    PaperGeneratorConfig,
    WeightOptions,
)
from ganlane.config.observation import FORMS, ObservationConfig
from ganlane.config.plain import plain_copy
from ganlane.config.store import SCHEMAS, SUFFIX, register
from ganlane.config.traffic_faults import (
    AbortFaultsConfig,
    BrakingFaultsConfig,
    HesitationFaultsConfig,
    IdmFaultsTrafficConfig,
    ReactionFaultsConfig,
)
from ganlane.data import NgsimParameters
from ganlane.errors import UserError
from ganlane.files import conf_folder
from ganlane.generator import (
    CalibratedConfig,
    LoopConfig,
    LossWeights,
    PaperConfig,
    load_generator,
    shipped_generator,
)
from ganlane.parameters.observation import MASKS, SensorParameters
from ganlane.parameters.reward import RewardParameters
from ganlane.traffic import AbortFaults, BrakingFaults, HesitationFaults, ReactionFaults
from ganlane.traffic.presets import DriverFaults
from ganlane.training.phases import describe, phases_of
from ganlane.transforms import OBSERVATIONS

#: Group to a command that has it.
USED_BY = {"data": "train_generator", "generator": "train_generator"}
#: What an option cannot do without.
NEEDS = {("env", "scene"): [f"env.scene.path={Path(__file__).parents[1] / 'reference' / 'scene.csv'}"]}
OPTIONS = sorted((path.parent.name, path.stem) for path in conf_folder().glob("*/*.yaml"))


@cache
def config_of(command, *overrides):
    """Composed and checked once for all tests, which only look at it."""
    return check(command, list(overrides)).config


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_composes_with_its_defaults(command):
    assert dataclasses.is_dataclass(config_of(command))


@pytest.mark.parametrize(("group", "option"), OPTIONS)
def test_every_option_composes(group, option):
    # The shipped agent may not be there yet, but its option must compose all the same.
    config_of(USED_BY.get(group, "train"), f"{group}={option}", *NEEDS.get((group, option), []))


#: Options with a dataclass of their own; the others' YAML says what differs from the option that they start from.
OWN_SCHEMA = [
    (group, option)
    for group, option in OPTIONS
    if group in ("observation", "mask") or option in SCHEMAS.get(group, {}) or group == "generator"
]


@pytest.mark.parametrize(("group", "option"), OWN_SCHEMA)
def test_yaml_and_dataclass_hold_the_same_values(group, option):
    needed = NEEDS.get((group, option), [])
    composed = config_of(USED_BY.get(group, "train"), f"{group}={option}", *needed)
    value = getattr(composed, group)
    if needed:
        assert value == type(value)(scene=value.scene)
        return
    expected = type(value)(form=option) if group in ("observation", "mask") else type(value)()
    assert value == expected


@pytest.mark.parametrize("command", COMMANDS)
def test_root_yaml_and_dataclass_hold_the_same_values(command):
    composed = config_of(command)
    default = type(composed)()
    for field in dataclasses.fields(composed):
        value = getattr(composed, field.name)
        plain = not dataclasses.is_dataclass(value) and not isinstance(value, dict)
        if plain or field.name in ("evaluation", "pretrain", "film", "curves"):
            assert value == getattr(default, field.name), field.name


def test_no_schema_is_without_its_yaml():
    register()
    for group, options in SCHEMAS.items():
        names = {path.stem for path in (conf_folder() / group).glob("*.yaml")}
        if group in ("observation", "mask"):
            assert names == set({"observation": FORMS, "mask": MASKS}[group])
        else:
            assert set(options) <= names, group
        assert {name + SUFFIX for name in options} <= {
            name.removesuffix(".yaml") for name in ConfigStore.instance().list(group or "")
        }


MIRRORS = [
    (NgsimDataConfig(), NgsimParameters, {"block_bytes"}),
    (LoopOptions(), LoopConfig, set()),
    (WeightOptions(), LossWeights, set()),
    (PaperGeneratorConfig(), PaperConfig, {"sizes", "loop", "weights", "seed"}),
    (CalibratedGeneratorConfig(), CalibratedConfig, {"sizes", "loop", "seed"}),
    (BrakingFaultsConfig(), BrakingFaults, set()),
    (ReactionFaultsConfig(), ReactionFaults, set()),
    (HesitationFaultsConfig(), HesitationFaults, set()),
    (AbortFaultsConfig(), AbortFaults, set()),
]


@pytest.mark.parametrize(("config", "kind", "apart"), MIRRORS, ids=lambda value: getattr(value, "__name__", ""))
def test_config_offers_every_parameter_with_the_same_default(config, kind, apart):
    copied = plain_copy(config, kind) if not apart else kind()
    for field in dataclasses.fields(kind):
        if field.name in apart:
            continue
        assert hasattr(config, field.name), f"{kind.__name__}.{field.name} cannot be set from the command line"
        given = getattr(config, field.name)
        assert (tuple(given) if isinstance(given, list) else given) == getattr(kind(), field.name), field.name
        assert getattr(copied, field.name) == getattr(kind(), field.name)


def test_calibrated_loop_is_the_presets_own():
    assert CalibratedLoopOptions().parameters() == CalibratedConfig().loop


def test_faults_of_the_command_line_reach_the_traffic():
    assert IdmFaultsTrafficConfig().arguments() == {"faults": DriverFaults()}
    mild = IdmFaultsTrafficConfig(late_reaction=ReactionFaultsConfig(per_hour=0.0)).faults()
    assert mild.late_reaction == ReactionFaults(per_hour=0.0)
    assert mild.phantom_braking == BrakingFaults()


def test_observation_forms_are_those_of_the_transform():
    assert set(FORMS) == set(OBSERVATIONS)


@pytest.mark.parametrize("form", FORMS)
def test_sensors_are_perfect_unless_an_error_is_asked_for(form):
    assert config_of("train", f"observation={form}").observation.sensors is None
    late = check("train", [f"observation={form}", "observation.sensors.delay_s=2"]).config.observation
    assert late == ObservationConfig(form=form, sensors=SensorParameters(delay_s=2.0))


def test_considerate_is_the_paper_and_a_price_for_danger_behind():
    paper, considerate = (config_of("train", f"reward={name}").reward for name in ("paper", "considerate"))
    assert dataclasses.asdict(considerate) == {**dataclasses.asdict(paper), "soft_crash_behind": -10.0}
    assert considerate.soft_crash_behind == considerate.soft_crash
    milder = config_of("evaluate", "reward.soft_crash_behind=-5").reward
    assert milder == RewardParameters(soft_crash_behind=-5.0)
    with pytest.raises(UserError, match=r"reward\.soft_crash_behind=3: expected at most 0"):
        check("train", ["reward=considerate", "reward.soft_crash_behind=3"])


def test_the_reward_stands_in_the_agents_metadata():
    config = config_of("train", "reward=considerate")
    assert describe(config, phases_of(config, Path("run"))[-1])["reward"]["soft_crash_behind"] == -10.0


@pytest.mark.parametrize("name", ["agent_idm", "agent_gan"])
def test_metadata_are_laid_out_as_in_the_agents_of_released_versions(name):
    config = config_of("train")
    now, shipped = describe(config, phases_of(config, Path("run"))[-1]), read_agent(name)[2]
    parts = [part for part in ("env", "agent", "reward", "observation_scale") if part in shipped]
    assert parts
    for part in parts:
        assert flat_types(shipped[part]).items() <= flat_types(now[part]).items(), part


def flat_types(node, prefix=""):
    """Type of each value by its dotted key; a whole number may stand for any, and null for anything."""
    found = {}
    for key, value in node.items():
        nested = flat_types(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": kind(value)}
        found.update(nested)
    return found


def kind(value):
    return "number" if type(value) in (int, float) or value is None else type(value).__name__


def test_dqn_switches_every_component_off():
    config = config_of("train", "agent=dqn").agent
    assert not any((config.noisy, config.dueling, config.distributional, config.double, config.prioritised))
    assert config.n_step == 1


def test_dense_traffic_keeps_the_density_for_any_number_of_vehicles():
    few, many = (check("train", ["env=dense", f"env.vehicles={n}"]).config.env for n in (30, 90))
    assert many.spread_m / many.vehicles == pytest.approx(few.spread_m / few.vehicles)
    assert many.spread_m == pytest.approx(3 * few.spread_m)


def test_paper_experiment_is_two_phases_and_can_be_shortened():
    config = check("train", ["experiment=paper", "total_decisions=7", "pretrain.total_decisions=5"]).config
    assert (config.pretrain.traffic.label(), config.traffic.label()) == ("idm_mobil", "gan")
    assert (config.pretrain.total_decisions, config.total_decisions) == (5, 7)
    whole = check("train", ["experiment=paper"]).config
    assert (whole.pretrain.total_decisions, whole.total_decisions) == (10_000_000, 3_000_000)
    assert whole.init.path is None


def test_a_generator_file_reaches_every_generated_traffic():
    config = check("evaluate", ["generator.path=mine.safetensors"]).config
    assert {config.traffic_options[name].path for name in ("gan", "gan_calibrated")} == {"mine.safetensors"}
    assert (
        check("train", ["traffic=gan", "generator.path=mine.safetensors"]).config.traffic.path == "mine.safetensors"
    )


def test_yaml_files_explain_themselves():
    for path in conf_folder().rglob("*.yaml"):
        first = next(line for line in path.read_text().splitlines() if not line.startswith("# @package"))
        assert first.startswith("# "), path
        assert OmegaConf.load(path) is not None


@pytest.mark.parametrize("options", [PaperGeneratorConfig(), CalibratedGeneratorConfig()], ids=lambda o: o.preset)
def test_the_weights_that_ship_were_fitted_with_the_commands_defaults(options):
    shipped = load_generator(shipped_generator(options.preset), options.preset)[1]["config"]
    assert json.loads(json.dumps(dataclasses.asdict(options.fit_config(seed=0)))) == shipped


@pytest.mark.parametrize("value", ["auto", "always", "never"])
def test_a_training_is_told_whether_to_compile(value):
    config = config_of("train", f"compile={value}")
    assert config.compile == value
    assert config_of("train", "total_decisions=16", f"compile={value}").compiled().env.compile is (value == "always")


@pytest.mark.parametrize(("version", "compiles"), [("2.11.0+cu130", False), ("2.13.0+cpu", True)])
def test_a_long_training_is_compiled_where_that_is_known_to_work(version, compiles, monkeypatch):
    monkeypatch.setattr("torch.__version__", version)
    monkeypatch.setattr("ganlane.runtime.has_compiler", lambda: True)
    assert config_of("train", "total_decisions=1000000").compiled().env.compile is compiles
