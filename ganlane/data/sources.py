"""Where recordings are on this machine, and how much of them has been read."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tqdm import tqdm

from ganlane.data.tables import OnProgress
from ganlane.errors import UserError
from ganlane.settings.generator import DataConfig

#: Environment variable with the folder of the recordings.
DATA_VARIABLE = "GANLANE_DATA"
SCENES = Path("ngsim") / "us101_scenes.csv"
_FOLDER = Path("shared") / "data"


def data_folder() -> Path | None:
    """Folder of the recordings.

    ``GANLANE_DATA``, else ``../shared/data`` next to the checkout or the current folder.

    Raises:
        UserError: the folder in ``GANLANE_DATA`` does not exist.
    """
    # A folder that was named must be there; the others may be.
    named = os.environ.get(DATA_VARIABLE)
    if named:
        if not Path(named).is_dir():
            raise UserError(
                f"{DATA_VARIABLE}={named}: no such folder; set it to the folder of the recordings "
                "or unset it."
            )
        return Path(named)
    # An installed package has no checkout around it, which does no harm.
    checkout = Path(__file__).resolve().parents[2]
    candidates = (
        checkout.parent / _FOLDER,
        Path.cwd().parent / _FOLDER,
    )
    return next((folder for folder in candidates if folder.is_dir()), None)


def default_scenes() -> Path:
    """Path of the US-101 scene CSV in :func:`data_folder`, in its folder ``ngsim`` or directly.

    Raises:
        UserError: it does not exist.
    """
    folder = data_folder()
    candidates = [] if folder is None else [folder / SCENES, folder / SCENES.name]
    for path in candidates:
        if path.is_file():
            return path
    # The message names what was looked for.
    looked = ", ".join(map(str, candidates)) or f"../{_FOLDER}"
    raise UserError(
        f"no recordings found (looked for {looked}); give data.path=FILE with a scene CSV, or set "
        f"{DATA_VARIABLE} to a folder that holds {SCENES}."
    )


def recordings_path(data: DataConfig) -> Path:
    """Path of the recordings that the group ``data`` names.

    Raises:
        UserError: there is no path and no default.
    """
    # Scenes have a default place; a raw recording is the user's own file.
    if data.format != "scenes" and data.path is None:
        raise UserError(f"data={data.format}: which file is missing; give data.path=FILE.")
    return Path(data.path) if data.path else default_scenes()


@contextmanager
def byte_progress(what: str) -> Iterator[OnProgress]:
    """Shows bytes done, rate and time left on stderr.

    Without a terminal every 10 s, and nothing of shorter work.
    """
    # Log files get a line every ten seconds at most.
    quiet_s = 0.0 if sys.stderr.isatty() else 10.0
    with tqdm(
        desc=what,
        unit="B",
        unit_scale=True,
        file=sys.stderr,
        delay=quiet_s,
        mininterval=max(0.1, quiet_s),
    ) as bar:

        def show(done: int, total: int | None) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show
