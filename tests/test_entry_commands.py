"""The console script.

Dispatch, help, mistakes that the commands find, commands in a process of their own.
"""

from __future__ import annotations

import entry_tiny
import pytest
from reference.refusals import refusal

from ganlane.__main__ import main
from ganlane.config.help import help_text
from ganlane.config.run import COMMANDS
from ganlane.files import conf_folder
from ganlane.settings.train import TrainConfig


def test_help_of_train_explains_every_traffic_and_start():
    text = help_text("train", TrainConfig)
    for group in (
        "traffic",
        "init",
        "experiment",
        "agent",
        "observation",
        "reward",
        "logger",
        "env",
    ):
        for path in (conf_folder() / group).glob("*.yaml"):
            assert path.stem in text, f"{group}={path.stem}"


def test_usage_lists_every_command(capsys):
    assert main([]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_cfg_shows_the_config_and_leaves_nothing_behind(name, empty_folder, capsys):
    assert main([name, "--cfg", "job"]) == 0
    shown = capsys.readouterr()
    assert "seed: 0" in shown.out
    assert shown.err == ""
    assert list(empty_folder.iterdir()) == []


#: Drives a short episode first; with the kernel a line would say so.
RENDER = "render traffic=idm agent=keep_lane env.kernel=torch env.goal_m=40"
#: Command line to a part of its sentence; what Hydra and the dataclasses refuse is in tests/config.
MISTAKES = {
    "evaluate agents=[nobody]": "agent nobody: unknown; choose one of random, random_legal",
    "evaluate agents=[gone.safetensors]": "agent gone.safetensors: no such file",
    "evaluate agents=[no.such.Policy]": "agents=no.such.Policy: 'no.such' cannot be imported",
    "evaluate agents=[os.path]": "expected a subclass of tensordict",
    "evaluate agents=[mobil] traffics=[no.such.Traffic]": "traffic._target_=no.such.Traffic",
    "evaluate agents=[mobil] traffics=[entry_own_parts.Missing]": "entry_own_parts has no Missing",
    "evaluate agents=[mobil] traffics=[entry_own_parts.Stubborn]": "expected a subclass of",
    "evaluate agents=[mobil] traffics=[entry_own_parts.not_a_model]": "expected a subclass of",
    "evaluate agents=[mobil] traffics=[{name:gan,path:gone}]": (
        "gone: no such file; a checkpoint of kind generator"
    ),
    "prepare data.path=gone.csv": "gone.csv: no such file",
    "prepare data=ngsim data.path=gone.csv": "gone.csv: no such file",
    "prepare data=highd data.path=gone.csv": "gone.csv: expected highD's XX_tracks.csv",
    "prepare data=ngsim": "data=ngsim: which file is missing; give data.path=FILE",
    "prepare data=scenes data.format=gpx": "data.format=gpx: expected one of scenes, ngsim, highd",
    "prepare device=cuda": "device=cuda",
    "render agent=nobody": "agent nobody: unknown",
    "render episodes=[0,1]": "a film shows one episode, not 2",
    "render out=a.html agents=[a,b,c,d] episodes=[0,1,2,3]": "16 episodes; choose at most 12",
    "render out=film.avi": "expected one of gif, mp4, png, html, parquet",
    "render run=nowhere": "nowhere: no metrics of a training run",
    "render out=film.svg": "expected one of gif, mp4",
    f"{RENDER} film.start_s=500 film.end_s=501 out=a.parquet": "choose a part",
    "render run=nowhere out=a.gif": "expected one of png, svg, pdf",
    "benchmark agent_idm@77": "no training with seed 77",
    "benchmark nobody": "agent nobody: unknown",
    "benchmark suite=shift-v0": "no such option (did you mean 'shift-v1'?)",
    "benchmark suite.scored.gan=1": "suite.scored.gan=1: expected a number from 2",
    "benchmark suite.shown.gan=5": "none of those in suite.shown",
    "benchmark suite.stream=train": "report, select, benchmark",
    "benchmark os:getcwd nowhere:drive": "nowhere",
    "train init=idm_ckpt init.path=gone.safetensors": "agent gone.safetensors: no such file",
    "train evaluation.agents=[nobody]": "agent nobody: unknown",
    "train traffic._target_=entry_own_parts.Missing": "entry_own_parts has no Missing",
    "train evaluation.traffic=gan evaluation.traffic.path=nowhere.safetensors": "nowhere.saf",
}


@pytest.mark.parametrize("line", MISTAKES)
def test_a_mistake_is_one_sentence_and_leaves_nothing(line, empty_folder, capsys):
    (empty_folder / "unmarked.md").write_text("nothing")
    command, *arguments = line.split()
    tiny = [*entry_tiny.TINY, "evaluation.agents=[random_legal]"] if command == "train" else []
    assert MISTAKES[line] in refusal(
        capsys, command, *tiny, *arguments, printed=command == "render"
    )
