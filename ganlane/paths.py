"""Folders that belong to the package: its configuration and the weights that come with it."""

from __future__ import annotations

from pathlib import Path

from ganlane.errors import UserError

PACKAGE = Path(__file__).resolve().parent
#: Weights that ship: ``agent_*.safetensors`` and ``generator_*.safetensors``.
CHECKPOINTS = PACKAGE / "checkpoints"


def conf_folder() -> Path:
    """Folder of the YAML files.

    In a checkout it lies beside the package; a wheel holds a copy inside. The one beside comes first, since an
    editable install can leave a stale copy behind.

    Raises:
        UserError: neither is there.
    """
    for folder in (PACKAGE.parent / "conf", PACKAGE / "conf"):
        # A folder 'conf' of somebody else may stand beside an installed package.
        if (folder / "train.yaml").is_file() and (folder / "traffic" / "gan.yaml").is_file():
            return folder
    raise UserError(f"{PACKAGE}: the folder conf/ is missing beside and inside it; install ganlane again.")
