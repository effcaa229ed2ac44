"""What other libraries, and the documents, do with the gymnasium environments."""

import importlib.util
import re

import gymnasium
import numpy as np
import pytest
from reference.gym_env import KEEP, LEFT, make, make_vec
from reference.processes import ROOT, python_blocks

VECTOR = gymnasium.wrappers.vector
MASKS_MAY_BE_ABSENT = tuple(map(int, re.findall(r"\d+", gymnasium.__version__)[:3])) >= (1, 2, 2)


@pytest.mark.parametrize("mode", ["same_step", "next_step"])
def test_gymnasiums_own_vector_wrappers_take_the_batch(mode):
    envs = VECTOR.RecordEpisodeStatistics(make_vec(4, goal_m=40.0, autoreset_mode=mode))
    if mode == "next_step":  # which the normalisation demands
        envs = VECTOR.NormalizeObservation(envs)
    envs.reset(seed=0)
    lengths = []
    for _ in range(12):
        *_, info = envs.step(np.zeros(4, int))
        if "episode" in info:
            lengths += info["episode"]["l"][info["_episode"]].tolist()
    assert len(lengths) >= 4
    assert all(1 <= length <= 6 for length in lengths)


@pytest.mark.skipif(not MASKS_MAY_BE_ABSENT, reason="DictInfoToList needs gymnasium 1.2.2 or newer")
def test_infos_of_a_batch_can_be_had_row_by_row():
    envs = VECTOR.DictInfoToList(make_vec(2, lanes=1, goal_m=500.0))
    envs.reset(seed=0)
    *_, infos = envs.step(np.array([KEEP, LEFT]))
    assert "final_info" not in infos[0]
    assert infos[1]["final_info"]["out_of_road"]
    assert infos[0]["reward_terms"].keys() == infos[1]["reward_terms"].keys()


@pytest.mark.usefixtures("empty_folder")
def test_the_code_in_the_docs_runs():
    blocks = python_blocks("gymnasium.md")
    films = importlib.util.find_spec("moviepy") is not None
    names = {"np": np}
    exec("\n".join(block for block in blocks if films or "RecordVideo" not in block), names)
    assert names["following"].shape == (64, 29)


def test_the_docs_list_every_info():
    page = (ROOT / "docs" / "gymnasium.md").read_text()
    table = re.search(r"\| key \| what \|\n(.*?)\n\n", page, re.S).group(1)
    listed = {
        name for row in table.splitlines()[1:] for name in re.findall(r"`(\w+)`", row.split("|")[1])
    }
    _, info = make().reset(seed=0)
    assert listed == set(info)
    assert set(re.search(r"`speed, (.*?)` \|", table).group(1).split(", ")) | {"speed"} == set(
        info["reward_terms"]
    )
