"""Hydra's flags: those that a run would pass over in silence are refused."""

from __future__ import annotations

import pickle

import pytest

from ganlane.evaluate import main


class Trap:
    """Writes a file when it is unpickled."""

    def __reduce__(self):
        return (open, ("sprung", "w"))


@pytest.mark.parametrize(
    ("flags", "told"),
    [
        (["--resolve"], "--resolve: it goes with --cfg alone"),
        (["--package", "env"], "--package: it goes with --cfg alone"),
        (["--info", "config", "--resolve"], "--resolve: it goes with --cfg alone"),
        (["--config-dir", "."], "--config-dir: ganlane has its own configuration"),
        (["--config-name", "train"], "--config-name: ganlane has its own configuration"),
        (["--cfg", "job", "--config-path", "."], "--config-path: ganlane has its own configuration"),
    ],
)
def test_a_flag_without_effect_is_refused_in_one_sentence(flags, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(flags) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"ganlane evaluate: {told}")
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_pickled_run_is_not_opened(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.pkl").write_bytes(pickle.dumps(Trap()))
    assert main(["--cfg", "job", "--experimental-rerun", "run.pkl"]) == 2
    assert "--experimental-rerun: ganlane has its own configuration" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["run.pkl"]


def test_resolve_and_package_go_with_cfg(capsys):
    assert main(["--cfg", "job", "--resolve", "--package", "env"]) == 0
    assert "lanes: 3" in capsys.readouterr().out
