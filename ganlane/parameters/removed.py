"""Options that lost the search of the hyperparameters (docs/search.md), and how files that name them are refused.

Agents, checkpoints and command lines of released versions hold these options at their defaults; those load as before.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

from ganlane.errors import UserError, as_typed


class RemovedOption(UserError):
    """A stored file or a command line asks for an option that was removed."""


#: The last revision that had them.
LAST_REVISION: Final = "2f3f5feca555"
#: Options of the agent and their defaults.
AGENT_OPTIONS: Final[dict[str, Any]] = {
    "encoder": "none",
    "encoder_width": 64,
    "encoder_layers": 2,
    "decide_when_free": False,
}
#: Those that changed what an agent does; the others were details of the encoder.
_SWITCHES: Final = ("encoder", "decide_when_free")
OBSERVATIONS: Final = ("fixed_order",)
_SEARCH: Final = "search/"


def without_removed(options: Mapping[str, Any], where: str) -> dict[str, Any]:
    """``options`` of a saved agent or network, without those that are no more; ``where`` names it in the error.

    Raises:
        RemovedOption: the agent was trained with one of them.
    """
    for name in _SWITCHES:
        if options.get(name, AGENT_OPTIONS[name]) != AGENT_OPTIONS[name]:
            raise _removed(where, f"agent.{name}={as_typed(options[name])}")
    return {name: value for name, value in options.items() if name not in AGENT_OPTIONS}


def refuse_removed_observation(form: str) -> None:
    """Raise :class:`RemovedOption` if ``form`` is an observation that is no more."""
    if form in OBSERVATIONS:
        raise _removed(f"observation={form}", "it")


def without_removed_overrides(overrides: Iterable[str], where: str) -> list[str]:
    """The command line of a run without the removed options, where it only repeats their defaults.

    Raises:
        RemovedOption: it sets one of them to something else, or names an experiment of the search.
    """
    kept = []
    for override in overrides:
        key, _, value = override.lstrip("+").partition("=")
        name = key.removeprefix("agent.")
        if name != key and name in AGENT_OPTIONS:
            if name in _SWITCHES and value != as_typed(AGENT_OPTIONS[name]):
                raise _removed(where, override)
        elif value in OBSERVATIONS or (key == "experiment" and value.startswith(_SEARCH)):
            raise _removed(where, override)
        else:
            kept.append(override)
    return kept


def _removed(where: str, what: str) -> RemovedOption:
    return RemovedOption(
        f"{where}: {what} was removed after revision {LAST_REVISION}; check out that revision to use it, or train a "
        "new agent."
    )
