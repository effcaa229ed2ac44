"""Files and folders are data: nothing that stands in them is executed.

Each way here would leave a marker.
"""

from __future__ import annotations

import io
import json
import pickle
import re
import sys
from pathlib import Path

import pytest
import torch
from reference.refusals import Bomb, refusal, run_folder, user_error

import ganlane
from ganlane.__main__ import main
from ganlane.agents import load_agent
from ganlane.api import train
from ganlane.arguments import import_target
from ganlane.config.compose import parsed
from ganlane.config.run import refuse_stored_imports
from ganlane.errors import UserError
from ganlane.files import CHECKPOINTS
from ganlane.generator import load_generator
from ganlane.realism.measures import Reference
from ganlane.settings.traffic import IdmTrafficConfig
from ganlane.settings.train import FinalEvaluationConfig, TrainConfig
from ganlane.traffic import TrafficModule
from ganlane.weights import load_weights, save_weights

MARKER = "executed"
#: A module that a folder brings along; importing it is enough.
EVIL = f"""
from pathlib import Path
Path({MARKER!r}).touch()
from os import system
from ganlane.traffic import IdmTraffic as Traffic
from ganlane.agents.drivers import KeepLaneDriver as Policy
def make(road) -> Traffic: return Traffic(road)
"""
#: YAML that names it, as an option of a group and as Hydra's own.
OPTION = """# @package _global_
traffic:
  _target_: evil.Traffic
hydra:
  callbacks: {x: {_target_: evil.make}}
"""


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """A working directory that somebody else has filled; a marker there fails the test."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", *sys.path])  # as python -m has it
    monkeypatch.delitem(sys.modules, "evil", raising=False)
    (tmp_path / "evil.py").write_text(EVIL)
    (tmp_path / "evil.yaml").write_text(OPTION)
    yield tmp_path
    assert not (tmp_path / MARKER).exists()
    assert "evil" not in sys.modules


def traffic_of(target, **arguments):
    """Settings of a run on the traffic that ``target`` makes."""
    return {"traffic": {"_target_": target, "arguments_": arguments}}


EVIL_TRAFFIC = {"_target_": "evil.Traffic"}
#: Settings in the config.yaml of a run that is to be resumed.
STORED = {
    "a class of a module beside it": {"traffic": EVIL_TRAFFIC},
    "a class by its name": {"traffic": "evil.Traffic"},
    "a shell": traffic_of("os.system", command="touch executed"),
    "the first phase's": {"pretrain": {"total_decisions": 8, "traffic": EVIL_TRAFFIC}},
    "the evaluation's": {"evaluation": {"traffic": EVIL_TRAFFIC}},
    "a share": {"traffic": {"name": "mixed", "shares": {"evil.Traffic": 1, "idm": 1}}},
    "a share's option": {"traffic": {"name": "mixed", "options": {"gan": EVIL_TRAFFIC}}},
    "a policy": {"evaluation": {"agents": ["mobil", "random_legal", "evil.Policy"]}},
    "a function as policy": {"evaluation": {"agents": ["mobil", "evil:make"]}},
    "a reference to a name": {
        "init": {"path": "evil.Traffic"},
        "traffic": {"_target_": "${init.path}"},
    },
    "an option elsewhere": {"traffic": "../../evil"},
    "another configuration": {"experiment": "../../evil"},
    "another list of defaults": {"defaults": ["../../evil"]},
    "another mask": {"mask": {"form": "../../evil"}},
    "a class to instantiate": {"agent": {"_target_": "evil.make"}},
    "Hydra's callbacks": {"hydra": {"callbacks": {"x": {"_target_": "evil.make"}}}},
    "a Ray cluster, which sends pickles": {"collector": {"address": "evil:6379"}},
}
#: Texts in its place that no such file has.
TEXTS = {
    "nothing": "",
    "a number": "3",
    "a YAML tag": "!!python/object/apply:os.system ['touch executed']",
    "a YAML tag as a name": "traffic: {name: !!python/name:evil.make }",
    "a list": "- traffic=idm\n- traffic._target_=evil.Traffic\n",
    "aliases of aliases": "a: &a [x, x]\nb: &b [*a, *a]\nc: &c [*b, *b]\n",
    "an endless alias": "&a {traffic: *a}",
    "a mapping merged into another": "a: &a {_target_: evil.Traffic}\ntraffic: {<<: *a}\n",
    "endless brackets": "[" * 100_000,
    "too large a file": "# " + "x" * 2**20,
}
CONFIGS = TEXTS | {way: json.dumps(stored) for way, stored in STORED.items()}


@pytest.mark.parametrize("way", CONFIGS)
def test_the_settings_of_a_run_execute_nothing_when_it_is_resumed(way, capsys):
    run_folder(CONFIGS[way])
    told = refusal(capsys, "train", "resume=run")
    if way in TEXTS:
        assert re.search(r"run/config\.yaml: (missing or )?damaged", told)
    with pytest.raises(UserError):
        train(folder="run", resume=True)


def test_a_wrong_value_in_the_settings_of_a_run_is_named(capsys):
    run_folder("env: {lanes: many}")
    assert "env.lanes=many" in refusal(capsys, "train", "resume=run")


@pytest.mark.parametrize(
    "arguments",
    [
        ["train", "traffic=idm", "init.path=bomb/last.pt"],
        ["evaluate", "agents=[bomb/agent.safetensors]"],
        ["evaluate", "agents=[bomb/last.pt]"],
        ["evaluate", "traffics={gan:{name:gan,path:bomb/agent.safetensors}}"],
        ["render", "run=bomb"],
        ["evaluate", "env=scene", "env.scene.path=bomb.json"],
        ["prepare", "data=scenes", "data.path=bomb.parquet"],
        ["prepare", "data=scenes", "data.path=bomb.csv"],
    ],
    ids=str,
)
def test_a_pickle_in_the_place_of_another_file_is_refused(arguments, here, capsys):
    file = io.BytesIO()
    torch.save({"kind": "ganlane training checkpoint", "version": 2, "state": Bomb()}, file)
    (here / "bomb").mkdir()
    names = "bomb/last.pt bomb/agent.safetensors bomb/metrics.csv bomb.json bomb.parquet bomb.csv"
    for name in names.split():
        (here / name).write_bytes(file.getvalue())
    assert "bomb" in refusal(capsys, *arguments)


def test_a_reference_of_recorded_driving_is_plain_numbers(here):
    (here / "reference.json").write_bytes(pickle.dumps(Bomb()))
    with user_error("not the histograms"):
        Reference.load(here / "reference.json")


@pytest.mark.parametrize("key", ["network", "observation_scale", "mask"])
def test_an_agents_description_is_not_instantiated(key):
    weights, metadata = load_weights(CHECKPOINTS / "agent_idm.safetensors", "agent")
    del metadata["kind"]
    called = {**metadata.get(key, {}), "_target_": "evil.make", "_partial_": False}
    save_weights("agent.safetensors", "agent", weights, {**metadata, key: called})
    with pytest.raises(UserError):
        ganlane.load_agent("agent.safetensors")
    save_weights("agent.safetensors", "agent", weights, {**metadata, "_target_": "evil.make"})
    assert load_agent("agent.safetensors")[1]["_target_"] == "evil.make"


@pytest.mark.parametrize("key", ["sizes", "preset"])
def test_a_generators_description_is_not_instantiated(key):
    weights, metadata = load_weights(CHECKPOINTS / "generator_paper.safetensors", "generator")
    del metadata["kind"]
    save_weights(
        "g.safetensors", "generator", weights, {**metadata, key: {"_target_": "evil.make"}}
    )
    with pytest.raises(UserError):
        load_generator("g.safetensors")


#: Command lines that would have Hydra import something, or read another configuration.
COMMAND_LINES = [
    ["+hydra.callbacks.x._target_=evil.make"],
    ["-m", "hydra.callbacks={x: {_target_: evil.make}}", "seed=0,1"],
    ["-m", "hydra/launcher=../../evil", "seed=0,1"],
    ["-m", "hydra.launcher._target_=evil.make", "seed=0,1"],
    ["-m", "hydra.searchpath=['file://.']", "seed=0,1"],
    ["--cfg", "job", "+hydra.callbacks.x._target_=evil.make"],
    ["~hydra.callbacks"],
    ["--experimental-rerun", "evil.pickle"],
    ["--config-dir", "."],
    ["experiment=../../evil"],
    ["-m", "experiment=paper,../../evil"],
]


@pytest.mark.parametrize("arguments", COMMAND_LINES, ids=" ".join)
def test_hydra_imports_nothing_and_reads_no_other_configuration(arguments, here, capsys):
    (here / "evil.pickle").write_bytes(pickle.dumps(Bomb()))
    refusal(capsys, "train", *arguments)


@pytest.mark.parametrize(
    "override",
    [
        "hydra.run.dir=out",
        "hydra.sweep.dir=out",
        "hydra/launcher=joblib",
        "hydra.launcher.n_jobs=2",
        "hydra.sweeper.max_batch_size=4",
        "+hydra.launcher.ray.init.num_cpus=2",
    ],
)
def test_what_sweeps_need_of_hydra_can_be_given(override):
    assert parsed("train", [override])[0].input_line == override


# --- what the user names


class NoTraffic:
    """Called by mistake, it leaves the marker."""

    def __init__(self, road):
        Path(MARKER).touch()


def traffic_without_annotation(road):
    Path(MARKER).touch()


def traffic_by_annotation(road) -> TrafficModule:
    return TrafficModule(road)


def something_else(road) -> NoTraffic:
    return NoTraffic(road)


def annotated_with_text(road) -> "a traffic":  # noqa: F722
    Path(MARKER).touch()


@pytest.mark.parametrize(
    "name",
    [
        "NoTraffic",
        "traffic_without_annotation",
        "something_else",
        "annotated_with_text",
        "MARKER",
        "json",
    ],
)
def test_what_is_named_is_called_only_if_it_makes_a_traffic(name, capsys):
    path = f"{__name__}.{name}"
    with user_error(r"expected a subclass of ganlane\.traffic\.TrafficModule or a function"):
        import_target(path, "traffic._target_", TrafficModule)
    told = refusal(capsys, "train", "traffic=idm", f"traffic._target_={path}")
    assert "_target_" in told


@pytest.mark.parametrize(
    "name",
    [
        "ganlane.traffic.IdmTraffic",
        "ganlane.traffic.presets.gan_traffic",
        f"{__name__}.traffic_by_annotation",
    ],
)
def test_a_class_or_an_annotated_function_is_taken(name):
    target = import_target(name, "traffic._target_", TrafficModule)
    assert target.__name__ == name.rpartition(".")[2]


@pytest.fixture
def foreign_run():
    """The record of a run on somebody's traffic, beside somebody's policy."""
    agents = ["mobil", "random_legal", "evil.Policy+safe"]
    return TrainConfig(
        resume="run",
        traffic=IdmTrafficConfig(_target_="evil.Traffic"),
        evaluation=FinalEvaluationConfig(agents=agents),
    )


@pytest.mark.parametrize(
    "keys", [["traffic._target_", "evaluation.agents"], ["traffic", "evaluation"]]
)
def test_a_resumed_run_takes_what_this_command_line_repeats(keys, foreign_run):
    refuse_stored_imports(foreign_run, keys)


@pytest.mark.parametrize(
    ("keys", "missing"),
    [
        (["traffic"], "evaluation.agents=[mobil,random_legal,evil.Policy+safe]"),
        (["evaluation.agents"], "traffic._target_=evil.Traffic"),
        # Keys beside it, and those of files, name no code.
        (["traffic.blind_share", "init.path", "resume"], "traffic._target_=evil.Traffic"),
    ],
)
def test_a_resumed_run_takes_no_more_than_that(keys, missing, foreign_run):
    with user_error(r"the run's file names evil\.") as caught:
        refuse_stored_imports(foreign_run, keys)
    assert f"add {missing} to the command line" in str(caught.value)


def test_a_command_does_not_look_for_modules_where_it_is_started(monkeypatch):
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place])
    main(["train", "resume=nowhere"])
    assert "" not in sys.path
