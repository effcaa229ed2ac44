"""``ganlane train`` from end to end, with tiny budgets, in process."""

import shutil
import signal
from functools import partial

import entry_tiny
import pytest
from reference.refusals import last_path, results_in
from training.small_runs import rows, signal_at

import ganlane
from ganlane.agents import read_agent
from ganlane.config.run import run_command

main = partial(run_command, "train")

TINY = [*entry_tiny.TINY, "evaluation.agents=[mobil,random_legal]"]
pytestmark = pytest.mark.usefixtures("empty_folder")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Folder of a tiny run that several tests look at; who goes on with it takes a copy."""
    folder = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main([*TINY, "evaluate_every=160", "selection_episodes=2"]) == 0
    (results,) = folder.rglob("results.json")
    return results.parent


def train(capsys, *arguments):
    """Run folder and results of a run that succeeds."""
    assert main([*TINY, *arguments]) == 0
    folder = last_path(capsys.readouterr().out).parent
    return folder, results_in(folder)


def test_a_run_leaves_agent_metrics_config_and_table(finished):
    results = results_in(finished)
    agents = [row["agent"] for row in results["rows"]]
    assert agents == ["trained", "mobil", "random_legal"]
    assert results["decisions"] == 320
    assert results["updates"] > 0
    for name in ("metrics.csv", "evaluation.csv"):
        assert [int(row["decisions"]) for row in rows(finished / name)] == [160, 320]
    weights, config, metadata = read_agent(finished / "agent.safetensors")
    assert weights
    assert config.agent.hidden == (16, 16)
    assert metadata["observation"] == "table3_progress"
    assert metadata["training"]["decisions"] == 320
    assert (finished / "config.yaml").is_file()


def test_a_new_run_in_the_folder_of_another_is_refused(finished, capsys, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "run")
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert main([*TINY, f"hydra.run.dir={folder}", "seed=9"]) == 2
    assert f"run: a run is there already; go on with resume={folder}, or" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_a_signal_saves_and_the_run_can_be_resumed(capsys, tmp_path):
    with signal_at(160, signal.SIGINT):
        # A training of this length would compile its update, which is no matter here.
        assert main([*TINY, "total_decisions=10000000", "compile=never"]) == 128 + signal.SIGINT
    assert "go on with: ganlane train resume=" in capsys.readouterr().err
    (checkpoint,) = tmp_path.rglob("last.pt")
    assert main(["resume=auto", "total_decisions=320"]) == 0
    assert rows(checkpoint.parents[1] / "metrics.csv")[-1]["decisions"] == 320


def test_the_second_phase_starts_from_the_first_ones_agent(capsys):
    phases = ["traffic@pretrain.traffic=idm_mobil", "pretrain.total_decisions=160"]
    folder, results = train(capsys, *phases)
    assert results["phases"]["pretrain"]["decisions"] == 160
    assert (folder / "pretrain" / "agent.safetensors").is_file()
    metadata = read_agent(folder / "agent.safetensors")[2]
    assert metadata["training"]["init"] == str(folder / "pretrain" / "agent.safetensors")


@pytest.mark.parametrize(("traffic", "init"), [("gan", "idm_ckpt"), ("gan_calibrated", "none")])
def test_every_traffic_and_every_start_runs(traffic, init, capsys):
    words = (
        "total_decisions=64 num_envs=16 env.goal_m=40 agent.warmup=256 log_every=64 "
        "evaluation.agents=[keep_lane] evaluation.episodes=1 agent.capacity=1000"
    )
    assert main([f"traffic={traffic}", f"init={init}", *words.split()]) == 0
    results = results_in(last_path(capsys.readouterr().out).parent)
    assert [row["traffic"] for row in results["rows"]] == [traffic, traffic]


def test_an_agent_that_sets_its_speed_does_so_wherever_it_drives(capsys):
    folder, results = train(capsys, "env.actions=lane_speed", "observation=lane_view")
    shares = [name for name in rows(folder / "metrics.csv")[0] if name.endswith("_share")]
    assert len([name for name in shares if name.startswith("action_")]) == 5
    # Elsewhere the environment takes its actions, and MOBIL's beside it are those of the lane.
    drivers = [str(folder / "agent.safetensors"), "mobil"]
    table = ganlane.api.evaluate(drivers, ["idm"], 2, goal_m=40.0)
    assert table["goal"].to_list() == [2, 2]
    assert results["rows"][0]["mean_reward"] == table["mean_reward"][0]


def test_a_resume_with_other_settings_is_refused_and_leaves_the_run_as_it_was(
    finished, capsys, tmp_path
):
    folder = shutil.copytree(finished, tmp_path / "run")
    settings_before = (folder / "config.yaml").read_text()
    for change in ("env.vehicles=5", "seed=5", "reward.goal=1000", "num_envs=8"):
        assert main([f"resume={folder}", "total_decisions=640", change]) == 2
        message = capsys.readouterr().err
        assert change.split("=")[0] in message
        assert "Traceback" not in message
    assert (folder / "config.yaml").read_text() == settings_before
    assert main([f"resume={folder}", "total_decisions=640"]) == 0
