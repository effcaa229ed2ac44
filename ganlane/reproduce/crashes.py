"""Crashes and departures from the road as a list that can be driven again: episode numbers and
actions, as JSON.

``ganlane reproduce`` writes such a list, ``ganlane render crashes=FILE`` plays it. Everything is
driven by the tensor code in batches of :data:`ROWS` rows: generated traffic repeats bit by bit in
batches of one size only, and a film shows what the tensor code drives.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any

import polars as pl
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torchrl.envs import EnvBase

from ganlane.build import make_driver, make_env, make_traffic
from ganlane.settings.commands import EvaluateConfig
from ganlane.settings.env import EnvConfig
from ganlane.config.schemas import SCHEMAS, made, node_of
from ganlane.settings.traffic import TRAFFICS, TrafficConfig
from ganlane.errors import UserError
from ganlane.evaluation.episodes import SIDES, Rollout, replay, roll_out
from ganlane.evaluation.results import plain
from ganlane.files import write_json
from ganlane.settings.record import NotNegative, Record, Rule, Seed, Text, one_of
from ganlane.settings.observation import MaskParameters, ObservationConfig, RewardParameters
from ganlane.sim.random import Stream

#: Rows of every batch in which a list is made and driven again.
ROWS = 8
#: Events that end a listed episode.
ENDS = ("hard_crash", "out_of_road")
_KIND = "ganlane crashes"
_ACTIONS = Rule(
    lambda text: re.fullmatch("[012]{1,100000}", text) is not None,
    "a text of the digits 0, 1 and 2",
)
#: Keys of a traffic that name code. A list holds none, so traffics that need code of a user's own
#: are not listed.
_CODE = {"_target_", "parameters"}
_LISTED = {name: kind for name, kind in TRAFFICS.items() if name != "mixed"}
#: Errors raised by reading a broken list.
_BROKEN = (
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    RecursionError,
    OmegaConfBaseException,
    UserError,
)


@dataclass(frozen=True)
class Crash(Record):
    """One episode that ended in a crash or beside the road.

    Attributes:
        driver: its name in the tables, for instance ``agent_gan@2+none``.
        traffic: option of the group ``traffic``.
        contact: what a hard crash hit (:data:`ganlane.evaluation.episodes.SIDES`).
        changing: whether the ego was changing lanes at the end.
        actions: one digit per decision: 0 keep, 1 left, 2 right.
    """

    driver: Text = "mobil"
    traffic: Annotated[str, one_of(_LISTED)] = "idm_mobil"
    seed: Seed = 0
    episode: Seed = 0
    end: Annotated[str, one_of(ENDS)] = "hard_crash"
    distance_m: NotNegative = 0.0
    contact: Annotated[str, one_of(SIDES)] = SIDES[0]
    changing: bool = False
    actions: Annotated[str, _ACTIONS] = "0"

    def steps(self) -> dict[int, list[int]]:
        """The episode's number and its actions, as :func:`ganlane.evaluation.replay` takes them."""
        return {self.episode: list(map(int, self.actions))}


@dataclass(frozen=True)
class CrashList:
    """Crashes, and what their episodes depend on.

    Environment, traffics and stream of random numbers.
    """

    env: EnvConfig
    traffics: Mapping[str, TrafficConfig]
    stream: str
    crashes: Sequence[Crash]

    def make_env(
        self,
        traffic: str,
        observation: ObservationConfig | None = None,
        reward: RewardParameters | None = None,
        mask: MaskParameters | None = None,
    ) -> EnvBase:
        """The environment that repeats this list's episodes on a traffic."""
        env = replace(self.env, kernel="torch", compile=False)
        model = make_traffic(self.traffics[traffic], env, Stream.named(self.stream))
        return make_env(model, env, observation, reward, ROWS, mask=mask)

    def drive_again(self) -> list[Rollout]:
        """The rollouts of the listed actions, in the order of the list."""
        rollouts: dict[tuple[str, str, int, int], Rollout] = {}
        for (driver, traffic, seed), group in groupby(
            self.crashes, attrgetter("driver", "traffic", "seed")
        ):
            actions = {number: steps for each in group for number, steps in each.steps().items()}
            for rollout in replay(self.make_env(traffic), actions, seed):
                rollouts[driver, traffic, seed, rollout.episode] = rollout
        return [
            rollouts[each.driver, each.traffic, each.seed, each.episode] for each in self.crashes
        ]


def find_crashes(
    episodes: pl.DataFrame, config: EvaluateConfig, most: int
) -> tuple[CrashList, int]:
    """Drive failed episodes again and list those that end in the same way.

    Args:
        episodes: rows of failed and other episodes, driven with ``config``.
        most: episodes per driver and traffic, those with the fewest decisions first.

    Returns:
        The list, and how many of the episodes ended otherwise: generated traffic rounds differently
        in batches of another size.
    """
    traffics = {
        name: option
        for name, option in config.traffics.items()
        if name in _LISTED and option._target_ == _LISTED[name]._target_ and not option.parameters
    }
    listed = CrashList(config.env, traffics, config.stream, [])
    failed = episodes.filter(pl.col("reason").is_in(ENDS), pl.col("traffic").is_in(list(traffics)))
    chosen = (
        failed.sort("decisions", "episode")
        .group_by("agent", "traffic", maintain_order=True)
        .head(most)
    )
    crashes: list[Crash] = []
    for (name, traffic), frame in chosen.sort("traffic", "agent").group_by(
        "agent", "traffic", maintain_order=True
    ):
        driver = make_driver(name, config.env)
        mask, policy = driver.behind(config.mask)
        env = listed.make_env(
            traffic, config.observation.read_by(driver.observation), config.reward, mask
        )
        ends = dict(zip(frame["episode"].to_list(), frame["reason"].to_list()))
        for each in roll_out(env, policy, sorted(ends), config.seed):
            if each.end == ends[each.episode]:
                outcome = (
                    each.end,
                    round(max(each.distance_m, 0.0), 1),
                    each.contact,
                    each.changing,
                )
                actions = "".join(map(str, each.actions))
                crashes.append(Crash(name, traffic, config.seed, each.episode, *outcome, actions))
    return replace(listed, crashes=crashes), len(chosen) - len(crashes)


def write_crashes(path: str | Path, listed: CrashList) -> None:
    """Write a list as JSON, atomically."""
    option = next(name for name, kind in SCHEMAS["env"].items() if kind is type(listed.env))
    used = {each.traffic for each in listed.crashes}
    traffics = {
        name: {key: value for key, value in asdict(traffic).items() if key not in _CODE}
        for name, traffic in listed.traffics.items()
        if name in used
    }
    env = {"option": option, **asdict(listed.env)}
    content = {
        "kind": _KIND,
        "stream": listed.stream,
        "env": env,
        "traffics": traffics,
        "crashes": listed.crashes,
    }
    write_json(path, plain(content))


def read_crashes(path: str | Path) -> CrashList:
    """Read what :func:`write_crashes` wrote.

    Raises:
        UserError: no such file, or not a list of crashes.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
        if content["kind"] != _KIND:
            raise ValueError("another kind of file")
        env, traffics = dict(content["env"]), dict(content["traffics"])
        # OmegaConf would replace ${...}.
        if "${" in json.dumps(content) or any(
            _CODE & options.keys() for options in traffics.values()
        ):
            raise ValueError("it names what is not plain data")
        crashes = [_typed(Crash, each) for each in content["crashes"]]
        return CrashList(
            _typed(SCHEMAS["env"][env.pop("option")], env),
            {
                name: _typed(_LISTED[name], traffics[name])
                for name in {each.traffic for each in crashes}
            },
            {stream: stream for stream in ("report", "select")}[content["stream"]],
            crashes,
        )
    except OSError as error:
        raise UserError(
            f"{path}: cannot be read; give the crashes.json of ganlane reproduce."
        ) from error
    except _BROKEN as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(
            f"{path}: not a list of crashes ({reason}); give the crashes.json of ganlane reproduce."
        ) from error


def _typed(kind: Any, values: Any) -> Any:
    """A dataclass of plain values, types and ranges checked."""
    return made(OmegaConf.merge(node_of(kind), values))
