"""Commands run from a call: in a folder of their own, which a mistake does not leave behind."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf

from ganlane.build import set_threads
from ganlane.config.folders import CONFIG, cleared_after_mistakes, put_back_after_mistakes
from ganlane.files import write_bytes

#: What a command does with its config in its run folder; it returns the line that names its result.
Command = Callable[[Any, Path], str]


@dataclass(frozen=True)
class Run:
    """What a command left: its folder and the content of ``results.json``."""

    folder: Path
    results: dict[str, Any]


def run_in(folder: str | Path | None, name: str, command: Command, config: Any) -> tuple[Path, str]:
    """Run ``command`` in ``folder``; the folder and the command's last line.

    Args:
        folder: the run's; None: a new one below ``outputs/NAME``.
        name: the command's.
        command: what runs.
        config: written beside the results as ``config.yaml``.
    """
    now = datetime.now().strftime("%Y-%m-%d_%H-%M-%S_%f")
    home = Path("outputs") / name / now if folder is None else Path(folder)
    with cleared_after_mistakes(home), put_back_after_mistakes(home), torch_threads():
        home.mkdir(parents=True, exist_ok=True)
        write_bytes(home / CONFIG, OmegaConf.to_yaml(OmegaConf.structured(config)).encode())
        return home, command(config, home)


def results_of(folder: Path) -> dict[str, Any]:
    """What a command wrote down there."""
    return json.loads((folder / "results.json").read_text())


@contextmanager
def torch_threads(threads: int = 0) -> Iterator[None]:
    """Torch's threads as the commands set them, and back again: the caller's session is not a command."""
    before = torch.get_num_threads()
    set_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)
