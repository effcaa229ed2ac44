"""``ganlane reproduce`` from end to end, with short episodes, in process."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import pytest

from ganlane.config.run import run_command
from ganlane.reproduce import cells

main = partial(run_command, "reproduce")
SHORT = [
    "episodes=3",
    "workers=1",
    "env.goal_m=60",
    "hydra.run.dir=out",
]
SMALL = ["agents=[random_legal,mobil,agent_idm@all+none,agent_gan+none]", "traffics=[idm,gan]"]
pytestmark = pytest.mark.usefixtures("empty_folder")


@pytest.fixture
def cells_driven(monkeypatch):
    """The cells that were driven, by driver and traffic."""
    driven, drive_cell = [], cells.drive_cell

    def noting(cell, config):
        driven.append((cell.driver, cell.traffic))
        drive_cell(cell, config)

    monkeypatch.setattr(cells, "drive_cell", noting)
    return driven


def curves(folder: Path, start: float) -> str:
    for part in (folder / "pretrain", folder):
        part.mkdir(parents=True, exist_ok=True)
        rows = "".join(f"{1000 * n},{start + n}\n" for n in (1, 2, 3))
        (part / "evaluation.csv").write_text(f"decisions,mean_reward\n{rows}")
    return str(folder)


def test_one_command_leaves_numbers_tables_and_figures_in_one_folder(cells_driven, capsys):
    runs = ",".join(curves(Path(f"runs/{seed}"), 100.0 * seed) for seed in (0, 1))
    assert (
        main(
            [
                *SHORT,
                *SMALL,
                "fewer={gan: 2, idm: 2}",
                f"runs=[{runs}]",
                "source=shipped",
            ]
        )
        == 0
    )
    out, folder = capsys.readouterr().out, Path("out")
    assert "Table VI: crashes" in out
    # agent_idm has five trainings
    assert len(cells_driven) == len(set(cells_driven)) == 2 * (3 + 5)

    page = (folder / "report.html").read_text()
    for said in ("19", "-22.33", "114.82", "2 on idm, 2 on gan", "agent_idm", "<svg"):
        assert said in page
    assert "http-equiv" not in page
    assert not any(f'{attribute}="http' in page for attribute in ("src", "href"))
    for name in ("matrix", "figure_3", "figure_4"):
        assert all((folder / f"{name}.{kind}").stat().st_size > 0 for kind in ("png", "svg", "csv"))
    for name in ("table_vi", "table_vii", "comparisons"):
        assert len((folder / f"{name}.csv").read_text().splitlines()) > 2

    # nobody but random_legal had time to
    assert json.loads((folder / "crashes.json").read_text())["crashes"] == []

    results = json.loads((folder / "results.json").read_text())
    assert results["seeds"]["episodes"] == {"idm": 2, "gan": 2}
    assert {(row["driver"], row["traffic"], row["episodes"]) for row in results["rows"]} >= {
        ("agent_idm+none", "idm", 2),
        ("agent_gan+none", "gan", 2),
    }
    assert all(seconds > 0.0 for seconds in results["seconds"].values())
    assert {"comparisons", "failures", "left_out", "cells", "code", "config"} <= results.keys()


def test_what_was_driven_is_not_driven_again_and_gives_the_same_numbers(
    cells_driven, capsys, monkeypatch
):
    # Drawing takes longest, and is looked at in the test above.
    monkeypatch.setattr(
        "ganlane.reproduce.report.save_figure", lambda figure, path: path.write_text("<svg/>")
    )
    line = [*SHORT, "agents=[random_legal,mobil]", "traffics=[idm]"]
    results = []
    for more in ([], [], ["agents=[random_legal,mobil,keep_lane]"], ["seed=1"]):
        assert main([*line, *more]) == 0
        results.append(json.loads(Path("out/results.json").read_text())["rows"])
    assert results[0] == results[1]
    drivers = ["random_legal", "mobil", "keep_lane", "random_legal", "mobil"]
    assert cells_driven == [(driver, "idm") for driver in drivers]
    for cell in Path("outputs/cells").glob("*.parquet"):
        cell.write_bytes(cell.read_bytes()[:-50])
    capsys.readouterr()
    assert main(line) == 2
    assert "not the episodes of a cell" in capsys.readouterr().err


def test_traffic_that_is_not_at_hand_is_left_out_and_said_so(monkeypatch, capsys):
    monkeypatch.setenv("GANLANE_DATA", "nowhere")
    assert main([*SHORT, "agents=[random_legal,mobil]", "traffics=[idm,replay]"]) == 0
    said = capsys.readouterr().err
    assert all(f"left out, {what}:" in said for what in ("replay", "figure 2", "figure 3"))
    results = json.loads(Path("out/results.json").read_text())
    assert results["left_out"].keys() == {"replay", "figure 2", "figure 3"}


def test_a_training_from_scratch_that_fails_is_named_after_the_hours_were(monkeypatch, capsys):
    run = Mock(return_value=Mock(returncode=2))
    monkeypatch.setattr("ganlane.commands.reproduce.subprocess.run", run)
    assert main([*SHORT, *SMALL, "source=scratch", "training_seeds=[4,5]"]) == 2
    error = capsys.readouterr().err
    assert "2 trainings, one after the other: about 2.2 hours on one core." in error
    assert "the same command goes on with it" in error
    training = "-m ganlane.train experiment=paper seed=4 hydra.run.dir=outputs/scratch/seed_4"
    assert run.call_args_list[0].args[0][1:] == training.split()
