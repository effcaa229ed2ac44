"""``ganlane benchmark`` from end to end, with short episodes, in process."""

import json
import re
import shutil
from functools import partial
from pathlib import Path

import jsonschema
import pytest
from reference.processes import ROOT
from reference.refusals import results_in, user_error

import ganlane
from ganlane.agents.checkpoint import agent_file
from ganlane.config.run import run_command, settings
from ganlane.evaluation.rows import FAILURES
from ganlane.suite import driving

main = partial(run_command, "benchmark")
SHORT = ["suite.env.goal_m=60", "hydra.run.dir=out", "suite.scored={idm: 2}"]
ALONE = [*SHORT, "suite.shown={}", "suite.baselines=[]"]
SCHEMA = json.loads((ROOT / "docs" / "results.schema.json").read_text())
pytestmark = pytest.mark.usefixtures("empty_folder")


@pytest.fixture
def cells_driven(monkeypatch):
    """The cells that were driven, by driver and traffic."""
    driven, drive_cell = [], driving._drive

    def noting(driver, config, file):
        (traffic,) = config.traffics
        driven.append((driver.name, traffic))
        return drive_cell(driver, config, file)

    monkeypatch.setattr(driving, "_drive", noting)
    return driven


def results():
    return results_in(Path("out"))


def entries(told):
    return {entry["entry"]: entry for entry in told["entries"]}


def test_one_command_leaves_a_table_results_and_a_page_with_films_of_failures(cells_driven, capsys):
    # Who drives at random leaves the road in the first seconds.
    scored = [*ALONE, "suite.scored={idm_mobil: 3, gan: 2}"]
    assert main([*scored, "agent_idm@all+none", "random", "films=2"]) == 0
    out = capsys.readouterr().out
    protocol = settings("benchmark", scored).protocol()
    assert f"shift-v1, protocol {protocol}" in out
    # agent_idm has five trainings
    assert len(cells_driven) == len(set(cells_driven)) == 2 * (3 + 5)
    told = results()
    assert told["protocol"] == protocol
    by_name = entries(told)
    trainings = {"random_legal": 1, "mobil": 1, "agent_idm+none": 5, "random": 1}
    assert {name: entry["trainings"] for name, entry in by_name.items()} == trainings
    assert (by_name["random_legal"]["score"], by_name["mobil"]["score"]) == (0.0, 100.0)
    jsonschema.validate(told, SCHEMA)
    page = Path("out/report.html").read_text()
    assert "agent_idm+none" in page
    assert not any(f'{attribute}="http' in page for attribute in ("src", "href"))
    (films,) = re.findall(r"Failures of random\b.*?<iframe(.*?)</iframe>", page, re.DOTALL)
    shown = re.findall(r"&quot;episode&quot;:(\d+)", films)
    failures = [row for row in told["failures"] if row["driver"] == "random"]
    listed = {number for row in failures for end in FAILURES for number in row[end]}
    assert len(shown) == 2
    assert {int(number) for number in shown} <= listed


def test_stored_results_are_of_the_published_schema_which_refuses_others():
    validator = jsonschema.Draft202012Validator(SCHEMA)
    validator.check_schema(SCHEMA)
    # A source distribution has no stored results.
    for file in (ROOT / "docs" / "leaderboard").glob("*.json"):
        whole = json.loads(file.read_text())
        validator.validate(whole)
        entry = {**whole["entries"][0], "score": "101.7"}
        for change in ({"schema": 2}, {"entries": [entry]}, {"sample": {"mobil": [1.0]}}):
            assert not validator.is_valid({**whole, **change})
        for name in whole:
            assert not validator.is_valid({key: whole[key] for key in whole if key != name})


def test_what_was_driven_is_not_driven_again_and_gives_the_same_numbers(cells_driven, capsys):
    told = []
    for more in ([], [], ["keep_lane"], ["seed=1"]):
        assert main([*ALONE, "random", *more]) == 0
        told.append(results()["rows"])
    assert told[0] == told[1]
    drivers = ["random_legal", "mobil", "random"]
    assert [driver for driver, _ in cells_driven] == [*drivers, "keep_lane", *drivers]
    for cell in Path("outputs/cells").glob("*.parquet"):
        cell.write_bytes(cell.read_bytes()[:-50])
    capsys.readouterr()
    assert main([*ALONE, "random"]) == 2
    assert "not the episodes of a cell" in capsys.readouterr().err


def test_traffic_that_is_not_at_hand_is_left_out_and_said_so(monkeypatch, capsys):
    monkeypatch.setenv("GANLANE_DATA", "nowhere")
    assert main([*SHORT, "suite.shown={replay: 5}", "suite.baselines=[]", "keep_lane"]) == 0
    assert "left out, replay:" in capsys.readouterr().err
    assert results()["left_out"].keys() == {"replay"}


def test_a_plain_function_of_observations_is_an_agent(cells_driven):
    Path("mine.py").write_text("def drive(observation):\n    return [0] * len(observation)\n")
    for _ in range(2):
        assert main([*ALONE, "mine:drive", "keep_lane"]) == 0
    rows = {row["driver"]: row["mean_reward"] for row in results()["rows"]}
    assert rows["mine:drive"] == rows["keep_lane"]
    # Nobody knows whether the function is still the same.
    assert cells_driven.count(("mine:drive", "idm")) == 2
    assert cells_driven.count(("keep_lane", "idm")) == 1


@pytest.mark.parametrize("returned", ["[0.0] * len(observation)", "[0, 1, 2]"])
def test_a_function_that_returns_something_else_is_refused_in_one_sentence(returned, capsys):
    module = f"wrong_{abs(hash(returned))}"
    Path(f"{module}.py").write_text(f"def drive(observation):\n    return {returned}\n")
    assert main([*ALONE, f"{module}:drive"]) == 2
    assert "drive: returned" in capsys.readouterr().err


def test_a_folder_of_trainings_is_one_entry():
    for number in range(2):
        folder = Path(f"sweep/{number}")
        folder.mkdir(parents=True)
        shutil.copy(agent_file("agent_idm"), folder / "agent.safetensors")
    assert main([*ALONE, "sweep"]) == 0
    assert entries(results())["sweep"]["trainings"] == 2


def test_the_protocol_is_that_of_everybody_and_changes_with_whatever_changes_a_result():
    def protocol(*words):
        return settings("benchmark", list(words)).protocol()

    shipped = protocol()
    assert shipped == protocol("keep_lane", "suite.baselines=[]", "threads=1", "num_envs=7")
    changes = ("seed=1", "quick=true", "suite.scored.gan=299", "suite.env.lanes=4", "suite=paper")
    assert len({shipped, *map(protocol, changes)}) == 1 + len(changes)


def test_python_takes_a_function_a_driver_and_names_of_your_own():
    def straight_on(observation):
        return [0] * len(observation)

    suite = {"name": "shift-v1", "scored": {"idm": 3}, "shown": {}, "baselines": []}
    suite["env"] = {"goal_m": 60}
    driver = ganlane.load_agent("agent_idm")
    agents = {"mine": straight_on, "theirs": driver, "rule": "keep_lane"}
    run = ganlane.benchmark(agents, suite=suite, folder="out")
    scores = {name: entry["score"] for name, entry in entries(run.results).items()}
    assert {row["traffic"] for row in run.results["rows"]} == {"idm"}
    assert scores.keys() == {"random_legal", "mobil", *agents}
    assert scores["mine"] == scores["rule"]
    with user_error("expected an agent's name, a policy or a function"):
        ganlane.benchmark(3, suite=suite)
