"""TensorBoard as a further log."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ganlane.errors import UserError


class TensorBoardLog:
    """TensorBoard event files in ``folder`` (extra ``tensorboard``)."""

    def __init__(self, folder: str | Path) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise UserError(
                "logger=tensorboard: tensorboard is not installed; run `pip install 'ganlane[tensorboard]'` or use "
                "logger=csv."
            ) from error
        self._writer = SummaryWriter(str(folder))

    def write(self, row: Mapping[str, float]) -> None:
        """Add every figure as a scalar over the decisions."""
        for name, value in row.items():
            if name != "decisions":
                self._writer.add_scalar(name, value, int(row["decisions"]))

    def close(self) -> None:
        """Flush and close."""
        self._writer.close()
