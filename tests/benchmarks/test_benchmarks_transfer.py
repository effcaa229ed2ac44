"""The paper's Figure 4 from the committed learning curves."""

import argparse

from benchmarks import transfer


def test_the_figure_is_drawn_from_the_committed_curves(tmp_path, monkeypatch):
    monkeypatch.setattr(transfer, "FIGURE", tmp_path / "figure.png")
    transfer.draw(argparse.Namespace())
    assert transfer.FIGURE.stat().st_size > 10_000
