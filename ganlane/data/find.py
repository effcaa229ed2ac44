"""Where the recordings are on this machine."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from ganlane.errors import UserError

#: Environment variable with the folder of the recordings.
VARIABLE: Final = "GANLANE_DATA"
SCENES: Final = Path("ngsim") / "us101_scenes.csv"
_FOLDER = Path("shared") / "data"


def data_folder() -> Path | None:
    """Folder of the recordings: ``GANLANE_DATA``, else ``../shared/data`` next to the checkout or the current folder.

    Returns:
        The folder, or None when the variable is unset and no such folder exists.

    Raises:
        UserError: the folder in ``GANLANE_DATA`` does not exist.
    """
    named = os.environ.get(VARIABLE)
    if named:
        if not Path(named).is_dir():
            raise UserError(
                f"{VARIABLE}={named}: no such folder; set it to the folder of the recordings or unset it."
            )
        return Path(named)
    checkout = Path(__file__).resolve().parents[2]
    candidates = (checkout.parent / _FOLDER, Path.cwd().parent / _FOLDER)
    return next((folder for folder in candidates if folder.is_dir()), None)


def default_scenes() -> Path:
    """Path of the US-101 scene CSV: ``ngsim/us101_scenes.csv`` in :func:`data_folder`, or the file directly in it.

    Raises:
        UserError: it does not exist; the message says what to do.
    """
    folder = data_folder()
    candidates = [] if folder is None else [folder / SCENES, folder / SCENES.name]
    for path in candidates:
        if path.is_file():
            return path
    looked = ", ".join(map(str, candidates)) or f"../{_FOLDER}"
    raise UserError(
        f"no recordings found (looked for {looked}); give data.path=FILE with a scene CSV, "
        f"or set {VARIABLE} to a folder that holds {SCENES}."
    )
