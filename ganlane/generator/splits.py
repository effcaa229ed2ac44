"""Splits of recorded scenes: fitted, validation (chooses when to stop) and held out (reported); k folds by scene."""

from __future__ import annotations

from typing import NamedTuple

from ganlane.errors import UserError
from ganlane.generator.windows import WINDOW_FRAMES, SceneTracks, count_windows

#: Least share of the remaining windows that the validation scenes hold.
VALIDATION_SHARE = 1 / 12


class Split(NamedTuple):
    """Scenes by use: fitted, validation (early stopping) and held out (reported)."""

    fitted: list[SceneTracks]
    validation: list[SceneTracks]
    held_out: list[SceneTracks]

    @property
    def names(self) -> dict[str, list[str]]:
        """Names of the scenes of each part."""
        return {part: [scene.name for scene in scenes] for part, scenes in self._asdict().items()}


def assign_folds(scenes: list[SceneTracks], folds: int) -> list[tuple[str, ...]]:
    """Names of the scenes in each fold, balanced: the largest first, each to the fold with the fewest windows so far.

    Raises:
        UserError: fewer than 2 folds, more folds than scenes with windows, or fewer than 3 such scenes.
    """
    usable = [scene for scene in scenes if count_windows(scene, WINDOW_FRAMES)]
    if not 2 <= folds <= len(usable) or len(usable) < 3:
        raise UserError(
            f"folds={folds}: {len(usable)} recorded scenes have windows to predict; choose 2 to {len(usable)} folds "
            "of at least 3 scenes."
        )
    names: list[list[str]] = [[] for _ in range(folds)]
    held = [0] * folds
    for scene in sorted(usable, key=lambda scene: (-count_windows(scene, WINDOW_FRAMES), scene.name)):
        fold = held.index(min(held))
        names[fold].append(scene.name)
        held[fold] += count_windows(scene, WINDOW_FRAMES)
    return [tuple(sorted(fold)) for fold in names]


def split_for_fit(scenes: list[SceneTracks], held_out: tuple[str, ...]) -> Split:
    """The three parts of a fit that reports ``held_out``.

    The smallest of the other scenes are for validation, as few as hold a twelfth of their windows. A single other
    scene is used for both fitting and validation.

    Raises:
        UserError: as :func:`split_scenes`.
    """
    others, kept = split_scenes(scenes, held_out)
    validation: list[SceneTracks] = []
    wanted, held = VALIDATION_SHARE * sum(count_windows(scene, WINDOW_FRAMES) for scene in others), 0
    for scene in sorted(others, key=lambda scene: (count_windows(scene, WINDOW_FRAMES), scene.name))[:-1]:
        if held >= wanted and held:
            break
        validation.append(scene)
        held += count_windows(scene, WINDOW_FRAMES)
    chosen = {scene.name for scene in validation} if held else set()
    fitted = [scene for scene in others if scene.name not in chosen]
    return Split(fitted, [scene for scene in others if scene.name in chosen] or fitted, kept)


def split_scenes(scenes: list[SceneTracks], held_out: tuple[str, ...]) -> tuple[list[SceneTracks], list[SceneTracks]]:
    """(others, held out), split by the scenes' names.

    Raises:
        UserError: there is only one scene, a held-out name is not among them, or one of the two parts is empty.
    """
    names = [scene.name for scene in scenes]
    if len(names) < 2:
        raise UserError(
            f"recordings of one scene, {', '.join(names)}: one has to be fitted to and another held out; cut it into "
            "several with ganlane prepare ... scene_s=30."
        )
    unknown = sorted(set(held_out) - set(names))
    if unknown:
        raise UserError(f"data.held_out={unknown}: not among the recorded scenes {names}; choose from these.")
    others = [scene for scene in scenes if scene.name not in held_out]
    kept = [scene for scene in scenes if scene.name in held_out]
    if not others or not kept:
        raise UserError(
            f"data.held_out={list(held_out)}: of the scenes {names} at least one must be held out and one fitted to; "
            "name some in data.held_out."
        )
    return others, kept
