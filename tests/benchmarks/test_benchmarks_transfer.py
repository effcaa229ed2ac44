"""The paper's Figure 4 from the committed learning curves."""

from __future__ import annotations

from benchmarks import transfer


def test_the_figure_is_drawn_from_the_committed_curves(tmp_path):
    assert transfer.main(["--out", str(tmp_path / "figure.png")]) == 0
    assert (tmp_path / "figure.png").stat().st_size > 10_000


def test_the_second_phase_goes_on_counting_where_the_first_one_ended():
    curves = transfer.read_curves([transfer.DOCS / "learning_curves" / "seed_0"])
    first = curves.filter(phase="first")["decisions"]
    second = curves.filter(phase="second")["decisions"]
    assert first[-1] < second[0]
