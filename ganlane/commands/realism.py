"""Make the realism card of a traffic: drive as configured, measure, show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

from ganlane.build import make_traffic
from ganlane.data.one_lane import ONE_LANE_FILES, one_lane_files, read_one_lane
from ganlane.data.recordings import read_scenes
from ganlane.data.sources import data_folder, default_scenes
from ganlane.errors import UserError
from ganlane.evaluation import write_results
from ganlane.evaluation.table import show
from ganlane.generator import HELD_OUT, Preset, shipped_generator
from ganlane.realism.card import card_numbers, card_rows
from ganlane.realism.driving import Factory, StartOptions
from ganlane.realism.long_runs import LongRunParameters, long_run
from ganlane.realism.measures import measure
from ganlane.realism.sheets import card_text, draw
from ganlane.realism.starts import (
    Starts,
    recorded_starts,
    simulate_all,
    spawned_starts,
)
from ganlane.settings.env import EnvConfig
from ganlane.settings.record import assign
from ganlane.settings.recordings import RealismConfig
from ganlane.settings.traffic import TrafficConfig
from ganlane.sim.random import Stream
from ganlane.sim.state import Road
from ganlane.traffic import TrafficModule
from ganlane.weights import load_weights

#: Preset of the weights that a traffic drives with.
PRESETS: Final[Mapping[str, Preset | Literal["human"]]] = {
    "human": "human",
    "gan": "paper",
    "gan_calibrated": "calibrated",
}
#: Quantities that one lane shows.
ONE_LANE_QUANTITIES: Final = ("speed", "acceleration", "time_headway")


def realism(config: RealismConfig, folder: Path) -> str:
    """Make a card: drive, measure, print and save; the line that names its results.

    Raises:
        UserError: recordings, weights or names that do not fit, or I-80 files that were asked for
            and are not there.
    """
    config = config.shortened()
    path = scenes_path(config)
    # Everything that can be refused is refused before hours of driving.
    factories = factories_on_card(config)
    files = files_wanted(config, path)
    starts = drive_from_starts(config, factories, path)

    # Empty without files of one lane; the card then leaves these rows out.
    site = {}
    for name, file in files.items():
        site[name] = one_lane_rows(config, factories, starts, name, file)
    # Long runs of the rivals take as long again, so they are made on request.
    runs = {}
    for name, make in factories.items():
        if name == config.traffic.label() or config.long_against:
            runs[name] = long_runs(config, name, make)

    # Measured and compared here; drawing and printing only show it.
    numbers = card_numbers(starts, site, runs, config.resamples)
    draw(numbers, starts, folder)
    show(*card_text(numbers), columns=config.columns)
    seeds = {"stream": "report", "seed": config.seed}
    return f"results: {write_results(folder, numbers, config, seeds)}"


def traffics_on_card(config: RealismConfig) -> dict[str, TrafficConfig]:
    """The card's traffic first, then its rivals."""
    return {config.traffic.label(): config.traffic, **config.rivals()}


def factories_on_card(config: RealismConfig) -> dict[str, Factory]:
    """What makes the card's traffics on a road, in their order."""
    traffics = traffics_on_card(config)
    return {name: partial(_make, traffic, config.env) for name, traffic in traffics.items()}


def scenes_path(config: RealismConfig) -> Path | None:
    """The recordings; None where none are named and none are found.

    Raises:
        UserError: the folder of data that was named is not there.
    """
    if config.data.path:
        return Path(config.data.path)
    data_folder()  # a folder that was named must be there
    try:
        return default_scenes()
    except UserError:
        return None


def _make(traffic: TrafficConfig, env: EnvConfig, road: Road) -> TrafficModule:
    """The traffic on a road."""
    # A copy that is not checked again: a recorded road need not fit Table II's vehicles.
    env = copy(env)
    assign(
        env,
        lanes=int(road.lanes),
        lane_width_m=float(road.lane_width_m),
    )
    # The stream of reported figures, never the one that recipes are chosen on.
    return make_traffic(traffic, env, Stream.REPORT)


def starts_and_held_out(
    config: RealismConfig, scenes: Sequence[str]
) -> tuple[Sequence[str], Sequence[str]]:
    """The scenes that traffics start from, and those that nothing was fitted to.

    Args:
        config: of the card.
        scenes: names of all scenes of the recordings.

    Raises:
        UserError: no scene is held out to start from.
    """
    # Nothing is held out of recordings that nothing is fitted to.
    held_out: Sequence[str] = ()
    if config.scenes != "all" or _fits(config, scenes):
        held_out = config.data.held_out_scenes(scenes, HELD_OUT)
    # Starts may include scenes of the fit; the card then shows the held-out ones apart.
    starts = scenes if config.scenes == "all" else held_out
    if not starts:
        raise UserError(
            f"recordings of one scene, {', '.join(scenes)}: none is held out to start from; give "
            "scenes=all, or cut it into several with ganlane prepare ... scene_s=30."
        )
    return starts, held_out


def _fits(config: RealismConfig, scenes: Sequence[str]) -> bool:
    """Whether something is, or was, fitted to some of the ``scenes``.

    Also where the user says which were held out.
    """
    # Desired speeds that are fitted need scenes of their own, too.
    if config.data.held_out is not None or config.desired_above_mps is None:
        return True

    used = traffics_on_card(config)
    for name in PRESETS.keys() & used.keys():
        # The file of weights tells what it was fitted to.
        path = getattr(used[name], "path", None) or shipped_generator(PRESETS[name])
        _, metadata = load_weights(path, "generator")
        data = metadata.get("data", {})
        # Scenes that chose the weights (early stopping) count as seen, like those of the fit.
        seen = {*data.get("fitted", ()), *data.get("validation", ())}
        if seen.intersection(scenes):
            return True
    return False


def drive_from_starts(
    config: RealismConfig,
    factories: Mapping[str, Factory],
    path: Path | None,
) -> Starts:
    """Drive every traffic from recorded scenes, or from spawned ones where there are none.

    Args:
        config: of the card.
        factories: what makes the traffics, by name.
        path: the recordings; None where there are none.

    Raises:
        UserError: recordings that cannot be read, or no scene to start from.
    """
    if path is None:
        spawn = config.env.spawn_parameters()
        return spawned_starts(factories, config.env.road(), spawn, config.repeats, config.seed)

    # Recorded starts: every vehicle begins where and as fast as it was recorded.
    frame = read_scenes(path)
    scenes = sorted(frame["scene"].unique().to_list())
    chosen, held_out = starts_and_held_out(config, scenes)
    # Desired speeds are fitted unless the user gives them.
    is_fitted = config.desired_above_mps is None
    options = StartOptions(repeats=config.repeats, seed=config.seed)
    if config.desired_above_mps is not None:
        options = replace(options, desired_above_mps=config.desired_above_mps)
    return recorded_starts(
        factories,
        chosen,
        held_out,
        frame,
        options,
        is_fitted,
        str(path),
    )


def files_wanted(config: RealismConfig, path: Path | None) -> dict[str, Path]:
    """The files of one lane next to the scenes that ``config`` asks for, by name.

    Raises:
        UserError: they are asked for, and none is there.
    """
    files = {}
    if path is not None and config.i80 is not False:
        files = one_lane_files(path)
    # Asked for in so many words, so leaving it out in silence would be wrong.
    if config.i80 and not files:
        raise UserError(
            f"i80=true: none of {', '.join(ONE_LANE_FILES.values())} lies next to the scenes; use "
            "i80=false."
        )
    return files


def one_lane_rows(
    config: RealismConfig,
    factories: Mapping[str, Factory],
    starts: Starts,
    name: str,
    path: Path,
) -> dict[str, Any]:
    """The card's rows on a file of one lane; nothing is fitted to the site.

    Args:
        config: of the card.
        factories: what makes the traffics, by name.
        starts: what was driven from the scenes; its desired speeds are those of the site, too.
        name: of the site, one of :data:`ganlane.data.one_lane.ONE_LANE_FILES`.
        path: its file.
    """
    # Once each: the site has many more segments than scenes.
    recordings = read_one_lane(name, path)
    options = StartOptions(seed=config.seed)
    driven = simulate_all(factories, recordings, options, starts.desired_above_mps)

    recorded = measure(recordings)
    # Lane changes and the like are not to be seen in one lane.
    counts = {quantity: recorded.counts[quantity] for quantity in ONE_LANE_QUANTITIES}
    in_one_lane = replace(recorded, counts=counts)
    site = replace(starts, driven=driven, recorded=in_one_lane)
    return card_rows(site, config.resamples)


def long_runs(config: RealismConfig, name: str, make: Factory) -> list[dict[str, Any]]:
    """One long run of a traffic per number of vehicles; none with ``vehicle_km=0``."""
    runs: list[dict[str, Any]] = []
    if config.vehicle_km == 0:
        return runs
    # Each number of vehicles is a density of its own, at the paper's spacing.
    for vehicles in config.long_vehicles:
        parameters = LongRunParameters(
            vehicles,
            config.vehicle_km,
            config.long_s,
            config.seed,
            config.env.spawn_parameters(),
        )
        runs.append(long_run(make, config.env.road(), parameters, name))
    return runs
