"""The calls of a notebook do what the commands do."""

import itertools
import json
import re
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import torch
from reference.processes import python_blocks
from reference.refusals import last_path, results_in, user_error

import ganlane
from ganlane.__main__ import main
from ganlane.agents.drivers import DRIVERS
from ganlane.settings.env import EnvConfig
from ganlane.settings.traffic import GanTrafficConfig
from ganlane.traffic import IdmTraffic

#: Blocks of the documentation that take long or need recordings.
LONG = re.compile(r"ganlane\.api\.(train|run)\(")


pytestmark = pytest.mark.usefixtures("empty_folder")


def test_every_name_at_the_top_is_there():
    for name in ganlane.__all__:
        assert getattr(ganlane, name) is not None
    assert set(ganlane.__all__) <= set(dir(ganlane))
    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        ganlane.nothing_of_the_kind  # noqa: B018


def test_an_environment_takes_what_the_command_line_takes():
    road = {"lanes": 4, "vehicles": 15, "recycle": True, "idm": {"headway_s": 1.2}}
    env = ganlane.make_env("idm", 3, **road, observation="table3", seed=4)
    base = env.base_env
    assert (base.road.lanes, base.vehicles, base.recycle) == (4, 15, True)
    assert base.rules.idm.headway_s == 1.2
    state = env.reset()
    assert state["observation"].shape == (3, 3 + 3 * 14)
    assert state["seed"].tolist() == [4, 4, 4]


def test_options_come_as_names_mappings_configs_and_classes():
    by_mapping = ganlane.make_env(
        {"name": "gan", "noise_scale": 0.0}, reward={"hard_crash": -200.0}
    )
    by_config = ganlane.make_env(
        GanTrafficConfig(noise_scale=0.0), env=EnvConfig(lanes=2), lane_width_m=3.5
    )
    assert by_config.base_env.road == ganlane.Road(2, 3.5)
    assert type(by_mapping.base_env.traffic) is type(by_config.base_env.traffic)
    assert by_mapping.transform[-1].parameters.hard_crash == -200.0
    assert isinstance(ganlane.make_env(IdmTraffic).base_env.traffic, IdmTraffic)
    assert ganlane.make_env("idm", env="cut_in", scene={"gap_m": 15.0}).base_env.vehicles > 1
    assert ganlane.make_env("idm", env="dense", vehicles=40).base_env.vehicles == 40


def test_a_loaded_agent_drives_an_environment():
    agent = ganlane.load_agent("agent_idm")
    env = ganlane.make_env("idm", 2, observation=agent.observation, goal_m=50.0)
    assert env.rollout(3, agent.policy)["action"].shape == (2, 3)
    mobil = ganlane.load_agent("mobil", lanes=5)
    assert (mobil.observation, mobil.policy.road.lanes) == (None, 5)
    assert ganlane.make_env("idm").reset()["observation"].shape == (1, 29)


def test_the_table_has_the_numbers_of_the_command(capsys):
    line = "agents=[mobil,random_legal] traffics=[idm,idm_mobil] episodes=3 env.goal_m=40 seed=2"
    assert main(["evaluate", *line.split()]) == 0
    folder = last_path(capsys.readouterr().out).parent
    rows = results_in(folder)["rows"]
    threads = torch.get_num_threads()
    agents, traffics = ["mobil", "random_legal"], ["idm", "idm_mobil"]
    table = ganlane.api.evaluate(agents, traffics, 3, seed=2, goal_m=40)
    assert torch.get_num_threads() == threads
    assert json.loads(json.dumps(table.to_dicts())) == rows
    assert table["episodes"].to_list() == [3] * 4
    assert table["normalized_percent"][0] == pytest.approx(100.0)
    assert (folder / "config.yaml").is_file()
    assert pl.read_parquet(folder / "episodes.parquet").height == 12


def test_own_drivers_and_own_names_stand_in_the_table():
    drivers = [DRIVERS["keep_lane"](ganlane.Road(3), 2), ganlane.load_agent("keep_lane")]
    traffics = {"quiet": {"name": "idm"}, "mine": IdmTraffic}
    table = ganlane.api.evaluate(drivers, traffics, 2, goal_m=30)
    pairs = itertools.product(traffics, ["KeepLaneDriver", "keep_lane"])
    assert table.select("traffic", "agent").rows() == list(pairs)
    assert table["mean_reward"].n_unique() == 1


def test_a_run_is_trained_resumed_and_evaluated():
    run = ganlane.api.train(
        "idm",
        "none",
        agent={"name": "rainbow", "warmup": 64, "capacity": 1000, "hidden": [16], "batch_size": 16},
        total_decisions=256,
        folder="run",
        logger={"progress": False},
        num_envs=8,
        goal_m=40.0,
        evaluation={"agents": ["mobil"], "episodes": 2},
    )
    assert (run.folder, run.agent) == (Path("run"), Path("run/agent.safetensors"))
    assert run.table["agent"].to_list() == ["trained", "mobil"]
    assert run.results["decisions"] >= 256
    table = ganlane.api.evaluate([str(run.agent)], ["idm"], 2, goal_m=40.0)
    assert table["mean_reward"][0] == run.table["mean_reward"][0]
    more = ganlane.api.train(total_decisions=512, folder="run", resume=True)
    assert more.results["decisions"] >= 512


def test_the_short_blocks_in_the_docs_run(capsys):
    code = [block for block in python_blocks("python_api.md") if not LONG.search(block)]
    assert len(code) == 5
    names, text = {}, "\n".join(code)
    exec(
        text.replace("episodes=100", "episodes=2, goal_m=30").replace(
            '"end_s": 5.0', '"end_s": 1.0'
        ),
        names,
    )
    assert names["table"].height == 6
    assert names["rollout"].batch_size == (64, 10)
    assert Path("film.gif").is_file()


def api(name, *arguments, **keys):
    """A call of the typed functions, which is made later."""
    return lambda: getattr(ganlane.api, name)(*arguments, **keys)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ganlane.make_env(lanes=np.array([1, 2])), "env.lanes=[1,2]: expected a whole"),
        (lambda: ganlane.make_env(traffic=None), "traffic=null: it has keys of its own"),
        (
            lambda: ganlane.make_env(reward={"base_speed_mps": 30.0}),
            "expected more than reward.base_speed_mps",
        ),
        (lambda: ganlane.make_env(transforms=["x"]), "give a list of TorchRL's transforms"),
        (lambda: ganlane.load_agent("x" * 10**5), "unknown; choose one of"),
        (lambda: ganlane.load_agent("x" * 10**5 + ".safetensors"), "no such file"),
        (api("evaluate", [42], ["idm"]), "42: expected an agent's name"),
        (api("evaluate", ["mobil"], {}), "a list of different traffics, not empty"),
        (api("run", "evaluate", folder=3), "folder=3: expected a path"),
        (api("evaluate", generator={"path": "x"}), "env.generator: no such key"),
        (api("train", "idm", resume=True), "resume=True: which run"),
        (api("train", "idm", resume=True, folder="gone"), "no run that can go on"),
        (api("run", "train", resume=5), "no run that can go on"),
        (api("render", run="gone"), "gone: no metrics of a training run"),
        (api("run", "realism", traffic="replay"), "traffic=replay: it is the recordings"),
        (api("run", "prepare", lanes=3), "lanes: no such key"),
        (api("run", "trian"), "no such command (did you mean 'train'"),
    ],
)
def test_a_mistake_is_one_sentence_and_leaves_nothing(call, message, tmp_path):
    with user_error(re.escape(message)) as caught:
        call()
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []
