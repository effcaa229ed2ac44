"""Drive episodes and write them as a Minari dataset."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Iterator
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from ganlane.build import make_driver
from ganlane.config.run import cleared_after_mistakes
from ganlane.errors import UserError
from ganlane.evaluation import write_results
from ganlane.evaluation.results import seeds_of
from ganlane.files import whole_folder
from ganlane.gym import ENV_ID
from ganlane.gym.rows import row_of
from ganlane.gym.tensor_rows import TensorRows
from ganlane.keys import ACTION, END_EVENTS, EPISODE
from ganlane.settings.commands import RecordConfig
from ganlane.settings.record import plain
from ganlane.sim.random import Stream

try:
    import minari
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage
except ImportError as error:
    raise UserError(
        "record: needs the extra 'minari'; run `pip install \"ganlane[minari]\"`."
    ) from error

#: Episodes that are written at a time: each time costs milliseconds.
_AT_ONCE = 64
#: Arguments of the environment that decide what its episodes are like.
_ARGUMENTS = (
    "traffic",
    "env",
    "observation",
    "reward",
    "mask",
    "stream",
)


def record(config: RecordConfig, folder: Path) -> str:
    """Drive the episodes and write them; the line that names the dataset.

    Raises:
        UserError: a dataset of this name is there already.
    """
    # The stream decides which episodes are driven; a random driver draws from it, too.
    stream = Stream.named(config.stream)
    driver = make_driver(config.driver, config.env, stream, config.device)
    # A trained agent reads the observation that it was trained with, whatever the command says.
    driven, policy = driver.driving(config)
    # More rows than episodes would drive some that nobody asked for.
    driven = replace(driven, num_envs=min(config.num_envs, config.episodes))
    rows = TensorRows(driven)

    # What minari's recover_environment() makes.
    # The specification is shared by the whole process, so a copy is changed.
    spec = deepcopy(gymnasium.spec(ENV_ID))
    spec.kwargs = {name: plain(getattr(driven, name)) for name in _ARGUMENTS}
    spec.max_episode_steps = rows.episode.most_decisions()

    # Minari finds a dataset by its name below a root folder.
    name = config.dataset_name()
    root = Path(config.out or folder).absolute()
    place = root / name
    if place.exists():
        raise UserError(
            f"{place}: a dataset is there already; give another dataset=NAME or out=FOLDER."
        )

    # A dataset that is half written is not found by Minari.
    with cleared_after_mistakes(place.parent), whole_folder(place) as part:
        storage = MinariStorage.new(part / "data", rows.space, rows.action_space(), spec)
        description = f"{driver.name} among {config.traffic.label()}, seed {config.seed}"
        storage.update_metadata(
            {
                "dataset_id": name,
                "algorithm_name": driver.name,
                "minari_version": minari.__version__,
                "description": description,
            }
        )
        episodes = _episodes(rows, policy, config)
        facts = _write(storage, episodes, config.episodes)

    numbers = {
        "dataset": name,
        "root": str(root),
        **facts,
    }
    write_results(folder, numbers, config, seeds_of(config))
    print(", ".join(f"{key.replace('_', ' ')} {value}" for key, value in facts.items()))
    return f"dataset: minari.load_dataset({name!r}) with MINARI_DATASETS_PATH={root}"


def _episodes(rows: TensorRows, policy: Any, config: RecordConfig) -> Iterator[EpisodeBuffer]:
    """The episodes as they end; row i of N drives i, i + N, i + 2N, ..."""
    # The episode that each row is in.
    buffers: dict[int, Any] = {}

    def begin(chosen: Iterable[int]) -> None:
        """Begin the episodes that the rows ``chosen`` have been reset to."""
        numbers = rows.array(EPISODE)
        for row in chosen:
            number = int(numbers[row])
            buffers[row] = EpisodeBuffer(
                id=number,
                seed=config.seed,
                options={"episode": number},
                observations=[],
                actions=[],
                infos={},
            )
        observe(chosen)

    def observe(chosen: Iterable[int]) -> None:
        """Add what the rows ``chosen`` are in to their episodes."""
        # A copy, since the rows write their next observations into the same array.
        observation = rows.observation().copy()
        info = rows.info()
        for row in chosen:
            buffers[row].observations.append(observation[row])
            _append(buffers[row].infos, row_of(info, row))

    rows.start(config.seed, np.arange(rows.count))
    begin(range(rows.count))
    # Numbers only grow: once all are beyond the last one asked for, every row is done.
    while any(buffer.id < config.episodes for buffer in buffers.values()):
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            # The policy may write into what it is given; the rows keep their own.
            decided = policy(rows.now().clone(recurse=False))
            actions = decided.get(ACTION).cpu().numpy()
        stepped = rows.step(actions)

        # The state after the last decision belongs to the episode, so observations are one more.
        observe(buffers)
        for row, buffer in buffers.items():
            buffer.actions.append(actions[row])
            buffer.rewards.append(stepped.reward[row])
            buffer.terminations.append(stepped.terminated[row])
            buffer.truncations.append(stepped.truncated[row])

        has_ended = stepped.terminated | stepped.truncated
        ended = np.flatnonzero(has_ended).tolist()
        for row in ended:
            # A row goes on with further episodes until all rows have driven theirs.
            if buffers[row].id < config.episodes:
                yield buffers[row]
        if ended:
            rows.restart(has_ended)
            begin(ended)


def _append(lists: dict[str, Any], values: dict[str, Any]) -> None:
    """Append every value to the list of its name, nested ones likewise."""
    for name, value in values.items():
        if isinstance(value, dict):
            _append(lists.setdefault(name, {}), value)
        else:
            lists.setdefault(name, []).append(value)


def _write(storage: Any, episodes: Iterator[EpisodeBuffer], count: int) -> dict[str, Any]:
    """Write the ``count`` episodes in the order of their numbers, as Minari wants.

    Returns:
        What they were like: number of ``episodes`` and ``decisions``, ``mean_return``, and
        ``ends``, how many episodes ended by which event.
    """
    # Episodes that have ended before one with a lower number.
    waiting: dict[int | None, EpisodeBuffer] = {}
    written = 0
    decisions = 0
    total_return = 0.0
    ends = Counter[str]()

    # Without a terminal there is no bar.
    for episode in tqdm(episodes, total=count, unit="episode", disable=None):
        decisions += len(episode)
        total_return += float(sum(episode.rewards))
        # Whether an event has happened stands in the last state.
        ends.update(event for event in END_EVENTS if episode.infos[event][-1])

        waiting[episode.id] = episode
        # Numbers from the next one on, as far as there is no gap.
        ready = list(itertools.takewhile(waiting.__contains__, itertools.count(written)))
        if len(ready) >= _AT_ONCE or written + len(ready) == count:
            storage.update_episodes([waiting.pop(number) for number in ready])
            written += len(ready)

    return {
        "episodes": written,
        "decisions": decisions,
        "mean_return": round(total_return / count, 2),
        "ends": dict(ends),
    }
