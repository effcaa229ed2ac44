"""The paper's Figure 4 from the committed learning curves."""

from benchmarks import transfer


def test_the_figure_is_drawn_from_the_committed_curves(tmp_path):
    assert transfer.main(["--out", str(tmp_path / "figure.png")]) == 0
    assert (tmp_path / "figure.png").stat().st_size > 10_000
