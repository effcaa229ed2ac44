"""Where a card goes: stdout, a document, figures, and the file that ships."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

from ganlane.cards.card import Card
from ganlane.cards.driving import say
from ganlane.config.folders import OVERRIDES
from ganlane.config.realism import RealismConfig
from ganlane.errors import UserError
from ganlane.evaluation import realism as package
from ganlane.evaluation.realism import Starts, document_text, floors_of, require_markers, update_document
from ganlane.files import write_bytes
from ganlane.view.figures import save_figure
from ganlane.view.realism import card_figures


def check_targets(config: RealismConfig, path: Path | None) -> None:
    """Raise :class:`UserError` where something cannot be written in the end, before anything is driven."""
    if config.publish and path is None:
        raise UserError("publish=true: the file that ships is made from recordings; give data.path=FILE.")
    if config.report is not None:
        require_markers(Path(config.report), config.card())
    if config.figures is not None and not Path(config.figures).is_dir():
        raise UserError(f"figures={config.figures}: no such folder; make it, or name another.")


def draw(card: Card, to: Path) -> list[Path]:
    """The figures of a card, into the folder ``to``."""
    figures = card_figures(card.starts, card.runs, card.quantities, card.traffic)
    return [save_figure(figure, to / f"{name}.png") for name, figure in figures.items()]


def show(
    config: RealismConfig, folder: Path, tables: list[str], numbers: Mapping[str, Any], drawn: Sequence[Path]
) -> None:
    """The tables on stdout; tables and figures where a document wants them."""
    print(*tables, sep="\n\n")
    if config.report is not None:
        text = document_text(tables, numbers, command_line(folder), date.today().isoformat())
        update_document(Path(config.report), config.card(), text)
    for path in drawn if config.figures is not None else []:
        write_bytes(Path(str(config.figures)) / f"realism_{path.name}", path.read_bytes())


def command_line(folder: Path) -> str:
    """How the run in ``folder`` was started, without where its document and figures went."""
    from omegaconf import OmegaConf

    asked = [str(override) for override in OmegaConf.load(folder / OVERRIDES)]
    kept = [override for override in asked if not override.startswith(("report=", "figures=", "hydra."))]
    return shlex.join(["python", "-m", "ganlane.realism", *kept])


def publish(starts: Starts) -> None:
    """Write the file that ships, with the floors as they were just measured."""
    source = Path(starts.reference.source).name
    floors = floors_of(starts.driven, starts.recorded)
    replace(starts.reference, floors=floors, source=source).save(package.SHIPPED_REFERENCE)
    say(f"wrote {package.SHIPPED_REFERENCE}")
