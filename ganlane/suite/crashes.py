"""Crashes and departures from the road as a list that can be driven again.

The list is JSON and holds episode numbers and actions; ``ganlane render crashes=FILE`` plays it.
``docs/reproduce/crashes.json`` is one. Everything is driven by the tensor code in batches of
:data:`ROWS` rows: generated traffic repeats there bit by bit in batches of one size only.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any

from torchrl.envs import EnvBase

from ganlane.build import make_env, make_traffic
from ganlane.errors import UserError
from ganlane.evaluation.episodes import ScriptedPolicy, run_episodes
from ganlane.evaluation.rows import FAILURES
from ganlane.files import read_whole
from ganlane.settings.env import EnvConfig
from ganlane.settings.observation import MaskParameters, ObservationConfig, RewardParameters
from ganlane.settings.record import (
    NotNegative,
    Record,
    Rule,
    Seed,
    Text,
    make,
    one_of,
)
from ganlane.settings.traffic import MixedTrafficConfig, OwnTraffic, TrafficConfig
from ganlane.sim.random import Stream

#: Rows of every batch in which a list is made and driven again.
ROWS = 8
_KIND = "ganlane crashes"
_ACTIONS = Rule(
    lambda text: re.fullmatch("[012]{1,100000}", text) is not None,
    "a text of the digits 0, 1 and 2",
)
#: A list names no code: no traffic of the user's own, and none that may have such parts.
_LISTED = {kind.option for kind in TrafficConfig.kinds().values()} - {  # type: ignore[attr-defined]
    OwnTraffic.option,
    MixedTrafficConfig.option,
}
#: Errors raised by reading a broken list.
_BROKEN = (ValueError, KeyError, TypeError, AttributeError, RecursionError, UserError)


@dataclass(frozen=True)
class Crash(Record):
    """One episode that ended in a crash or beside the road.

    Attributes:
        driver: its name in the tables, for instance ``agent_gan@2+none``.
        traffic: option of the group ``traffic``.
        actions: one digit per decision: 0 keep, 1 left, 2 right.
    """

    driver: Text = "mobil"
    traffic: Text = "idm_mobil"
    seed: Seed = 0
    episode: Seed = 0
    end: Annotated[str, one_of(FAILURES)] = "hard_crash"
    distance_m: NotNegative = 0.0
    actions: Annotated[str, _ACTIONS] = "0"


@dataclass(frozen=True)
class CrashList(Record):
    """Crashes, and what their episodes depend on: environment, traffics, stream of randomness."""

    env: EnvConfig
    traffics: dict[str, TrafficConfig]
    stream: Annotated[str, one_of(("report", "select"))]
    crashes: list[Crash]

    def make_env(
        self,
        traffic: str,
        observation: ObservationConfig | None = None,
        reward: RewardParameters | None = None,
        mask: MaskParameters | None = None,
    ) -> EnvBase:
        """The environment that repeats this list's episodes on a traffic."""
        # The tensor code, so that a list plays the same with and without the native kernel.
        env = replace(self.env, kernel="torch")
        # The same stream of randomness, so that others start and act as they did.
        model = make_traffic(self.traffics[traffic], env, Stream.named(self.stream))
        return make_env(model, env, observation, reward, ROWS, mask=mask)

    def drive_again(self) -> list[str]:
        """Drive every crash with its actions; how each ends, in the order of the list."""
        ends: list[str] = []
        for (_, traffic, seed), group in groupby(
            self.crashes, attrgetter("driver", "traffic", "seed")
        ):
            # One script for all episodes of a driver on a traffic: they are driven side by side.
            actions = {crash.episode: crash.actions for crash in group}
            env = self.make_env(traffic)
            table = run_episodes(env, ScriptedPolicy(actions), list(actions), seed)
            ends += table["reason"].to_list()
        return ends


def read_crashes(path: str | Path) -> CrashList:
    """Read a list from its file.

    Raises:
        UserError: no such file, or not a list of crashes.
    """
    try:
        return _checked(json.loads(read_whole(Path(path))))
    except OSError as error:
        raise UserError(f"{path}: cannot be read; give docs/reproduce/crashes.json.") from error
    except _BROKEN as error:
        # Errors of libraries may have many lines; a user's mistake is one sentence.
        reason = " ".join(str(error).split())[:200]
        raise UserError(
            f"{path}: not a list of crashes ({reason}); give docs/reproduce/crashes.json."
        ) from error


def _checked(content: Any) -> CrashList:
    """The list of a file's content; one of :data:`_BROKEN` for what is not such a list."""
    # Other JSON files of a run are refused before their keys are looked at.
    if content["kind"] != _KIND:
        raise ValueError("another kind of file")
    crashes = content["crashes"]
    traffics = {}
    for name in {crash["traffic"] for crash in crashes}:
        options = content["traffics"][name]
        # Only this package's traffics: an import path in a file would be code to execute.
        if name not in _LISTED or {"_target_", "name"} & set(options):
            raise ValueError(f"traffic {name!r:.80} is none of this package's")
        traffics[name] = make(TrafficConfig, {"name": name, **options}, "traffics")
    listed = {name: content[name] for name in ("stream", "env", "crashes")}
    return make(CrashList, {**listed, "traffics": traffics})
