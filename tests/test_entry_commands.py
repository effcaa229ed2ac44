"""The console script.

Dispatch, help, mistakes that the commands find, commands in a process of their own.
"""

import pytest
import yaml
from reference.refusals import refusal

from ganlane.__main__ import main
from ganlane.config.run import COMMANDS, call_settings
from ganlane.settings.record import make


def test_usage_lists_every_command(capsys):
    assert main([]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_cfg_shows_the_config_and_leaves_nothing_behind(name, empty_folder, capsys):
    assert main([name, "--cfg", "job"]) == 0
    shown = capsys.readouterr()
    assert make(COMMANDS[name], yaml.safe_load(shown.out)) == call_settings(name, {})
    assert shown.err == ""
    assert list(empty_folder.iterdir()) == []


#: Drives a short episode first; with the kernel a line would say so.
RENDER = "render traffic=idm agent=keep_lane env.kernel=torch env.goal_m=40"
#: Command line to a part of its sentence.
MISTAKES = {
    # Refused by the settings.
    "train env.lane=3": "env.lane: no such key (did you mean 'lanes'?)",
    "train env.idm.gap=2": "env.idm.gap: no such key; env.idm has comfortable_deceleration",
    "train pretrain.traffic.guard=false": "pretrain.traffic._target_: of which traffic? name it",
    "train traffic=mixed traffic.options.idm.blind_share=1": "traffic.options.idm: it has no share",
    "train traffic=mixed traffic.shares={replay:1}": "traffic.shares=replay: it plays recordings",
    "train traffic=idm traffic.pace=2": "traffic.pace: no such key; traffic has _target_, blind_",
    "train traffic=ganny": "traffic=ganny: no such option (did you mean 'gan'?)",
    "train env=[a,b]": "choose one of blocked_lane",
    "train env.idm=3": "env.idm.NAME=VALUE",
    "train ++env.wheels=3": "env.wheels: no such key",
    "train ~env.lanes": "keys cannot be deleted",
    "train lanes": "not of the form key=value",
    "train env.lanes=0": "expected a number above 0; 0 means what a scene's file says",
    "train reward=considerate reward.soft_crash_behind=3": "expected at most 0",
    "train --quick": "--quick: no such flag; run the command with --help",
    "train seed=0,1": "add -m for a sweep",
    "train -m seed=0,-1": "seed=-1: expected a number from 0",
    "train -m seed=0,1 traffic=idm,ganny": "traffic=ganny: no such option",
    "train -m seed=0,1 resume=auto": "one run is resumed at a time",
    "train resume=nowhere": "resume=nowhere: no checkpoint there",
    "train env.vehicles=100": "env.vehicles=100 do not fit: 3 lanes x 9 vehicles",
    "train env.decision_period_s=0.15": "not a multiple of 0.1 s",
    "train agent.warmup=5": "expected at least agent.batch_size=256",
    "train pretrain.total_decisions=10": "give for instance pretrain.traffic=idm_mobil",
    "train traffic._target_=nonsense": "expected an import path",
    "train hydra.nonsense=1": "hydra.nonsense: no such key",
    "evaluate traffic=gan": "did you mean traffics=[NAME,NAME]?",
    "evaluate traffics=[gann]": "traffic=gann: no such option (did you mean 'gan'?)",
    "render film.start_s=9 film.end_s=3": "expected more than film.start_s=9",
    "render out=nowhere/film.gif": "out=nowhere/film.gif: expected a file in a folder that exists",
    "train_generator generator=gann": "choose one of calibrated, human, paper, social_gan",
    "train_generator folds=1": "one fold leaves nothing to fit to",
    "train env=scene": "env.scene.path: no file; give one",
    "evaluate env=cut_in env.vehicles=5": "env.vehicles=5: the scene has 6",
    "evaluate env=cut_in env.lanes=1": "env=cut_in needs 2 lanes or more",
    "evaluate env=stalled_car env.spread_m=300": "env.spread_m=300",
    "evaluate env=cut_in env.scene.gap_m=3 env.scene.speed_mps=36": "would need 100 m/s2",
    "evaluate env.min_spacing_m=12": "raise env.min_spacing_m to 17.8",
    "evaluate seed=1,2": "seed=1,2: several values; write [a,b] for a list, or add -m",
    "evaluate --cfg job agents=[mobil,mobil]": "a list of different entries",
    # Refused by the commands.
    "evaluate agents=[nobody]": "agent nobody: unknown; choose one of random, random_legal",
    "evaluate agents=[gone.safetensors]": "agent gone.safetensors: no such file",
    "evaluate agents=[no.such.Policy]": "agents=no.such.Policy: 'no.such' cannot be imported",
    "evaluate agents=[os.path]": "expected a subclass of tensordict",
    "evaluate agents=[mobil] traffics=[no.such.Traffic]": "traffic._target_=no.such.Traffic",
    "evaluate agents=[mobil] traffics=[entry_own_parts.Missing]": "entry_own_parts has no Missing",
    "evaluate agents=[mobil] traffics=[{name:gan,path:gone}]": (
        "gone: no such file; a checkpoint of kind generator"
    ),
    "prepare data.path=gone.csv": "gone.csv: no such file",
    "prepare data=ngsim data.path=gone.csv": "gone.csv: no such file",
    "prepare data=highd data.path=gone.csv": "gone.csv: expected highD's XX_tracks.csv",
    "prepare data=ngsim": "data=ngsim: which file is missing; give data.path=FILE",
    "prepare data=scenes data.format=gpx": "data.format=gpx: expected one of scenes, ngsim, highd",
    "prepare device=cuda": "device=cuda",
    "render episodes=[0,1]": "a film shows one episode, not 2",
    "render out=a.html agents=[a,b,c,d] episodes=[0,1,2,3]": "16 episodes; choose at most 12",
    "render out=film.avi": "expected one of gif, mp4, png, html, parquet",
    "render run=nowhere": "nowhere: no metrics of a training run",
    "render out=film.svg": "expected one of gif, mp4",
    f"{RENDER} film.start_s=500 film.end_s=501 out=a.parquet": "choose a part",
    "render run=nowhere out=a.gif": "expected one of png, svg, pdf",
    "benchmark agent_idm@77": "no training with seed 77",
    "benchmark nobody": "agent nobody: unknown",
    "benchmark suite.shown.gan=5": "none of those in suite.shown",
    "benchmark suite.stream=train": "report, select, benchmark",
    "benchmark os:getcwd nowhere:drive": "nowhere",
    "train init=idm_ckpt init.path=gone.safetensors": "agent gone.safetensors: no such file",
    "train evaluation.agents=[nobody]": "agent nobody: unknown",
    "train evaluation.traffic=gan evaluation.traffic.path=nowhere.safetensors": "nowhere.saf",
}


@pytest.mark.parametrize("line", MISTAKES)
def test_a_mistake_is_one_sentence_and_leaves_nothing(line, empty_folder, capsys):
    (empty_folder / "unmarked.md").write_text("nothing")
    printed = line.startswith("render")
    assert MISTAKES[line] in refusal(capsys, *line.split(), printed=printed)
