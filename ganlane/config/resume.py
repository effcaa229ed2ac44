"""``resume=...``: use the folder and the command line of the resumed run."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from ganlane.config.command_line import leaves, of_hydra, parse, quoted, without_repetitions
from ganlane.config.folders import CONFIG, OVERRIDES
from ganlane.config.targets import is_import_path
from ganlane.config.train import TrainConfig
from ganlane.errors import UserError, as_typed
from ganlane.parameters.agent import without_removed_overrides

_RUNS = Path("outputs")
#: The checkpoint of a run, below its folder.
LAST = Path("checkpoints") / "last.pt"
#: Last parts of the keys that name code to execute: import paths, and a Ray cluster's address.
_IMPORTED_BY = ("_target_", "shares", "agents", "address")
#: Keys whose defaults have changed since version 0.1.0.
CHANGED_SINCE_0_1 = ("total_decisions", "collector.num_envs", "evaluation.episodes")


def with_resumed(command: str, overrides: Sequence[str], multirun: bool) -> list[str]:
    """The overrides, preceded by those of the resumed run, with its folder as run folder.

    Args:
        command: only ``train`` resumes this way.
        overrides: of the command line.
        multirun: whether it is a sweep.

    Raises:
        UserError: there is no such run, or the command line is a sweep.
    """
    asked = _asked(overrides) if command == "train" else None
    if asked is None:
        return list(overrides)
    if multirun:
        raise UserError(f"resume={asked}: one run is resumed at a time; start without -m.")
    run = newest_unfinished(_RUNS / command) if asked == "auto" else run_folder(Path(asked))
    if run is None:
        print(f"resume=auto: no unfinished run below {_RUNS / command}; a new one is started.", file=sys.stderr)
        return without_repetitions([*overrides, "resume=null"])
    stored = [*_old_defaults(run), *_stored(run / OVERRIDES)]
    return without_repetitions([*stored, *overrides, f"resume={quoted(run)}", f"hydra.run.dir={quoted(run)}"])


def _old_defaults(run: Path) -> list[str]:
    """Overrides with the old defaults, for a run that was started before train's defaults changed.

    Such a run has no ``compile`` in its config.yaml, from which the numbers and the form of the mask are taken.
    """
    try:
        config: Any = OmegaConf.load(run / CONFIG)
        if "compile" in config:
            return []
        kept = {key: OmegaConf.select(config, key) for key in CHANGED_SINCE_0_1}
        mask = OmegaConf.select(config, "mask.form") or "none"
    except Exception:  # missing, or not YAML; reading the checkpoint will report what is wrong
        return []
    numbers = [f"{key}={quoted(value)}" for key, value in kept.items()]
    return [f"mask={mask}", "agent=rainbow", "compile=never", *numbers]


def _stored(path: Path) -> list[str]:
    """The command line of a run.

    Raises:
        UserError: the file is not a list of overrides.
    """
    try:
        found = OmegaConf.to_container(OmegaConf.load(path))
    except Exception:  # a file that is not YAML can raise many errors
        found = None
    if not isinstance(found, list) or not all(isinstance(override, str) for override in found):
        raise UserError(
            f"{path}: damaged, expected a list of key=value; write the run's command line there, or start a new run."
        )
    kept = without_removed_overrides(map(str, found), str(path))
    for override in OverridesParser.create().parse_overrides(kept):
        if of_hydra(override):
            raise UserError(f"{path}: {override.input_line}: Hydra is not set by a run's files; remove that line.")
    return kept


def refuse_stored_imports(config: TrainConfig, overrides: Sequence[str]) -> None:
    """Refuse code from outside the package that the run's files name, unless the command line names it too.

    Args:
        config: of the resumed run.
        overrides: of this command line alone.

    Raises:
        UserError: the run's files name a class or function of another package, or a Ray cluster.
    """
    asked = [each for each in parse(overrides) if each.key_or_group.rpartition(".")[2] in _IMPORTED_BY]
    named = {name.partition("+")[0] for override in asked for name in leaves(override.value())}
    for key, path in _imports(config):
        if not path.startswith("ganlane.") and path not in named:
            raise UserError(
                f"resume={config.resume}: the run's files name {path}, and code from there would be executed; if you "
                f"trust it, add {key} to the command line."
            )


def _imports(config: TrainConfig) -> Iterator[tuple[str, str]]:
    """Every import path of a run, and Ray's address, each with the override that names it."""
    address = getattr(config.collector, "address", None)
    if address not in (None, "auto"):  # a cluster sends pickles
        yield f"collector.address={address}", str(address)
    traffics = {"pretrain.traffic": config.pretrain.traffic, "traffic": config.traffic}
    for key, traffic in {**traffics, "evaluation.traffic": config.evaluation.traffic}.items():
        if traffic is not None:
            yield f"{key}._target_={traffic._target_}", traffic._target_
            shares = ",".join(f"{name}:{share}" for name, share in getattr(traffic, "shares", {}).items())
            for name, part in traffic.parts().items():
                known = name in getattr(traffic, "options", {})
                yield (
                    f"{key}.options.{name}._target_={part._target_}" if known else f"'{key}.shares={{{shares}}}'",
                    part._target_,
                )
    agents = config.evaluation.agents
    for name in agents:
        path = name.partition("+")[0]
        if is_import_path(path) and not path.endswith(".safetensors") and not Path(path).is_file():
            yield f"evaluation.agents={as_typed(agents)}", path


def _asked(overrides: Sequence[str]) -> str | None:
    values = [override.value() for override in parse(overrides) if override.key_or_group == "resume"]
    return str(values[-1]) if values and values[-1] not in (None, "") else None


def run_folder(path: Path) -> Path:
    """The run that ``path`` belongs to: its folder, a phase's folder, or a checkpoint.

    Raises:
        UserError: there is no run.
    """
    if path.is_file() and path.name != "last.pt":
        raise UserError(f"resume={path}: a run continues from its last.pt only; give the run's folder.")
    candidates = [path, *path.parents[:3]] if path.exists() else []
    for folder in candidates:
        if (folder / OVERRIDES).is_file() and any(folder.rglob("last.pt")):
            return folder
    expected = path / LAST if path.is_dir() else path
    if not expected.is_file():
        raise UserError(f"resume={path}: no checkpoint there ({expected}); give a run's folder, its {LAST}, or auto.")
    raise UserError(f"resume={path}: {OVERRIDES} is missing there; give the folder that the run was written to.")


def newest_unfinished(runs: Path) -> Path | None:
    """The run with the newest checkpoint among those without results; None if there is none."""
    checkpoints = sorted(runs.rglob("last.pt"), key=lambda path: path.stat().st_mtime, reverse=True)
    for checkpoint in checkpoints:
        folder = next((parent for parent in checkpoint.parents if (parent / OVERRIDES).is_file()), None)
        if folder is not None and not (folder / "results.json").is_file():
            return folder
    return None
