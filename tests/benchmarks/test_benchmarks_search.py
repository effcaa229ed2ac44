"""The table of a search, on made-up run folders."""

import csv

import pytest

from benchmarks.search import BEGIN, END, compact, differing, main, read_runs, table


def make_run(folder, config, evaluations=(), metrics=((1000, 2.0),)):
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(config)
    lines = ["decisions,wall_s", *(f"{decisions},{seconds}" for decisions, seconds in metrics)]
    (folder / "metrics.csv").write_text("\n".join(lines) + "\n")
    if evaluations:
        head = "decisions,mean_reward,standard_error,crash_rate,lane_changes_per_km"
        rows = [",".join(map(str, row)) for row in evaluations]
        (folder / "evaluation.csv").write_text("\n".join([head, *rows]) + "\n")


@pytest.fixture
def sweep(tmp_path):
    folder = tmp_path / "sweep"
    shared = "seed: 0\nthreads: {}\nenv: {{lanes: 3}}\n"
    make_run(
        folder / "2",
        shared.format(1) + "agent: {gamma: 0.98, noisy: true, hidden: [256, 256]}\n",
        [(500, 10.0, 2.0, 0.1, 0.5), (1000, 12.5, 1.5, 0.05, 0.7)],
        [(500, 1.0), (1000, 4.0)],
    )
    make_run(
        folder / "10",
        shared.format(2) + "agent: {gamma: 0.99, noisy: false, hidden: [64]}\n",
        [(500, 20.0, 2.5, 0.0, 1.25), (1000, 15.0, 3.0, 0.2, 2.0)],
    )
    return folder


def test_only_the_options_that_differ_are_columns_and_the_agent_of_the_first_phase_is_no_run_of_its_own(
    sweep,
):
    (sweep / "2" / "pretrain").mkdir()
    (sweep / "2" / "pretrain" / "metrics.csv").write_text("decisions,wall_s\n1,1\n")
    assert len(read_runs([sweep])) == 2
    assert differing(read_runs([sweep])) == ["agent.gamma", "agent.noisy", "agent.hidden"]


def test_runs_are_ranked_by_their_best_evaluation(sweep):
    first, second = table(read_runs([sweep]))
    assert first == {
        **{
            "run": "sweep/10",
            "agent.gamma": "0.99",
            "agent.noisy": "false",
            "agent.hidden": "[64]",
        },
        **{"decisions": "1000", "best": "20.0", "best s.e.": "2.5", "best at": "500"},
        **{
            "last": "15.0",
            "last s.e.": "3.0",
            "crash rate": "0.000",
            "changes/km": "1.25",
            "decisions/s": "500",
        },
    }
    assert [second[name] for name in ("run", "best", "last", "decisions/s")] == [
        "sweep/2",
        "12.5",
        "12.5",
        "250",
    ]


def test_a_reader_sees_only_what_is_unlike_most_runs(sweep):
    for name in ("3", "4"):
        make_run(
            sweep / name,
            "seed: 0\nenv: {lanes: 3}\nagent: {gamma: 0.98, noisy: true, hidden: [64]}\n",
        )
    runs = read_runs([sweep])
    shown = [row["what differs"] for row in compact(table(runs), differing(runs))]
    assert shown == [
        "`agent.gamma=0.99 agent.noisy=false`",
        "`agent.hidden=[256,256]`",
        *["(the middle)"] * 2,
    ]


def test_a_run_without_an_evaluation_or_a_standard_error_has_empty_cells(sweep):
    make_run(sweep / "11", "seed: 0\nagent: {gamma: 0.9}\n", metrics=())
    last = table(read_runs([sweep]))[-1]
    assert last["agent.gamma"] == "0.9"
    assert last["agent.noisy"] == "null"
    assert {
        last[name] for name in ("best", "best at", "last", "crash rate", "decisions", "decisions/s")
    } == {""}
    (sweep / "2" / "evaluation.csv").write_text("decisions,mean_reward,crash_rate\n500,99,0\n")
    best = table(read_runs([sweep]))[0]
    assert (best["best"], best["best s.e."], best["changes/km"]) == ("99.0", "", "")


def test_the_table_goes_into_a_document_and_a_csv_file(sweep, tmp_path, capsys):
    page, sheet = tmp_path / "search.md", tmp_path / "search.csv"
    page.write_text(f"# Search\n\n{BEGIN}\nold\n{END}\n")
    assert main([str(sweep), "--report", str(page), "--csv", str(sheet)]) == 0
    lines = page.read_text().splitlines()
    assert lines[3].startswith("| what differs | decisions | best |")
    assert lines[4] == f"|{' --- |' * 10}"
    assert "agent.hidden=[256,256]" in lines[6]
    with sheet.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["agent.hidden"] for row in rows] == ["[64]", "[256,256]"]
    assert lines[5] in capsys.readouterr().out


def test_a_folder_without_runs_is_one_sentence(tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert capsys.readouterr().err == (
        f"error: {tmp_path}: no run there with config.yaml and metrics.csv; give the folder of a sweep.\n"
    )
