"""What the single environment and the batch have in common: their rows, and their specification."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

from gymnasium.envs.registration import EnvSpec

from ganlane.gym.native_rows import native_rows
from ganlane.gym.rows import Rows
from ganlane.settings.commands import HighwayConfig, highways


def make_rows(
    traffic: Any, count: int, pictures: bool, transforms: Sequence[Any], keys: Mapping[str, Any]
) -> Rows:
    """N highways with the arguments of :func:`ganlane.api.make_env`.

    Without torch where the native kernel can drive them. With ``pictures`` the kernel drives them
    behind the TorchRL environment, since drawing needs torch anyway.

    Raises:
        UserError: a wrong value.
    """
    # Checked here, so that both kinds of rows get values that will do.
    config = highways(traffic=traffic, num_envs=count, **keys)
    # The native kernel records no physics steps for pictures and knows no TorchRL transforms.
    if not pictures and not len(transforms):
        rows = native_rows(config)
        if rows is not None:
            return rows
    from ganlane.gym.tensor_rows import TensorRows  # torch takes seconds

    return TensorRows(config, transforms)


class OnRows:
    """Base of the environments on :class:`~ganlane.gym.rows.Rows`."""

    _rows: Rows
    _spec: EnvSpec | None = None

    @property
    def settings(self) -> HighwayConfig:
        """What the highways were made with: traffic, observation, mask, ..."""
        return self._rows.config

    @property
    def transforms(self) -> Sequence[Any]:
        """TorchRL transforms of the user's own."""
        return self._rows.transforms

    @property
    def spec(self) -> EnvSpec | None:
        """gymnasium's specification; ``max_episode_steps`` follows from ``timeout_s``."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        # A copy: gymnasium's registry holds the original.
        self._spec = copy.copy(spec)
        # gymnasium.make() sets it after the constructor, so the rows are there already.
        if self._spec is not None:
            self._spec.max_episode_steps = self._rows.episode.most_decisions()
