"""What ``sim`` (speed, growth, memory), ``traffic`` (each model) and ``train`` (with learning)
measure.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ganlane.bench.measure import (
    COLUMNS,
    EAGER,
    NATIVE,
    Case,
    Group,
    Row,
    Suite,
    best_rows,
    growth_per_environment,
    speed_table,
)
from ganlane.bench.systems import (
    BaselinesRunner,
    GymnasiumRunner,
    HighwayEnvRunner,
    Scenario,
    Training,
    installed_version,
    start_environment,
    start_envpool,
    start_physics,
    start_traffic,
    start_training,
)
from ganlane.build import make_traffic
from ganlane.settings.commands import BenchConfig
from ganlane.settings.env import DenseEnvConfig, EnvConfig
from ganlane.evaluation.table import NOTHING, Table, significant
from ganlane.settings.observation import ObservationConfig, RewardParameters

PHYSICS, ENVIRONMENT, GYMNASIUM = "ganlane physics", "ganlane environment", "ganlane gymnasium"
TRAFFIC, TRAINING = "ganlane traffic", "ganlane training"
_START: dict[str, Any] = {
    PHYSICS: start_physics,
    ENVIRONMENT: start_environment,
    GYMNASIUM: GymnasiumRunner,
}
#: What stands for the traffic of HighwayEnv.
_THEIR_TRAFFIC = "its IDM and MOBIL"


class SimSuite(Suite):
    """Speed at every batch; growth of the cost with the batch and with the vehicles, eager; memory."""

    name = "sim"

    def __init__(self, config: BenchConfig) -> None:
        recycle = not make_traffic(config.traffic, config.env).own_roads
        super().__init__(replace(config, env=replace(config.env, recycle=recycle)))
        self.memory = config.memory
        if not recycle:
            self.notes.append(
                "Not recycled: recorded vehicles go where they went, so the road empties."
            )
        self.has_peer = config.peers and installed_version("highway-env") is not None
        if config.peers and not self.has_peer:
            self.notes.append(
                "HighwayEnv is not installed, so there are no ratios to it; "
                '`pip install "ganlane[bench]"` (or `pip install highway-env`) brings it.'
            )
        self.has_envpool = config.peers and installed_version("envpool") is not None
        # A scene set by hand has as many vehicles as it has.
        self.grows = type(config.env) in (EnvConfig, DenseEnvConfig)
        if not self.grows:
            self.notes.append(
                "Not measured: growth with the vehicles; their number belongs to the scene."
            )

    def groups(self) -> list[Group]:
        """Speed at every batch in turns with HighwayEnv.

        Growth with the batch and with the vehicles.
        """
        reference = self.peer() if self.has_peer else None
        found = []
        for device, threads in self.places():
            for batch in self.config.batches:
                cases = [
                    self._case("speed", system, mode, device, threads, batch)
                    for system in _START
                    for mode in self.config.modes
                    if system != GYMNASIUM or (mode == NATIVE and device == "cpu")
                ]
                if self.has_envpool and device == "cpu":
                    cases.append(self._envpool(threads, batch))
                found.append(
                    Group(f"{device}, threads {threads}, batch {batch}", threads, cases, reference)
                )
        return found + [
            group for system in (PHYSICS, ENVIRONMENT) for group in self._growth(system)
        ]

    def peer(self) -> Case:
        """HighwayEnv on the suite's road; it does not use torch, so one thread is all it has."""
        name = f"HighwayEnv {installed_version('highway-env')}"
        labels = self.labels(name, _THEIR_TRAFFIC, EAGER, 1, 1, dtype="float64")
        return Case(labels, partial(HighwayEnvRunner, self.config.env, self.config.seed))

    def _envpool(self, threads: int, batch: int) -> Case:
        """HighwayEnv in C++ on the suite's road."""
        labels = self.labels(
            f"EnvPool {installed_version('envpool')}", _THEIR_TRAFFIC, NATIVE, threads, batch
        )
        return Case(
            labels, partial(start_envpool, self.config.env, batch, threads, self.config.seed)
        )

    def _growth(self, system: str) -> list[Group]:
        """Two or more sizes side by side, on the first device."""
        config = self.config
        device, threads = config.chosen_devices()[0], config.threads[0]
        case = partial(self._case, system=system, mode=EAGER, device=device, threads=threads)
        large = [batch for batch in config.batches if batch >= config.linear_from]
        counts = config.vehicle_counts if self.grows else []
        sizes = {
            "batch": [case("batch", batch=batch) for batch in large],
            "vehicles": [
                case("vehicles", batch=config.scaling_batch, vehicles=number) for number in counts
            ],
        }
        return [
            Group(f"{system}, growth with the {what}", threads, cases)
            for what, cases in sizes.items()
            if len(cases) > 1
        ]

    def _case(
        self,
        part: str,
        system: str,
        mode: str,
        device: str,
        threads: int,
        batch: int,
        vehicles: int | None = None,
    ) -> Case:
        """With so many ``vehicles`` the first scene grows to keep the density of Table II.

        It is then wider than the range of recycling, which would crowd it; in so short a time no
        ego leaves it.
        """
        scenario = Scenario.of(self.config)
        if vehicles is not None:
            spread_m = max(scenario.env.spread_m, DenseEnvConfig().metres_per_vehicle * vehicles)
            env = replace(scenario.env, vehicles=vehicles, spread_m=spread_m, recycle=False)
            scenario = replace(scenario, env=env)
        place = {"part": part, "device": device, "vehicles": scenario.env.vehicles}
        labels = self.labels(system, scenario.traffic.label(), mode, threads, batch, **place)
        return Case(labels, partial(_START[system], scenario, mode, device, batch))

    def findings(self, rows: Sequence[Row]) -> dict[str, Any]:
        """``ratios``: each system's best row against the peer; ``scaling``.

        ``memory`` per environment.
        """
        compared = [row for row in rows if row["system"] in _START and row["ratio"] is not None]
        return {
            "ratios": best_rows(compared, "ratio"),
            "scaling": scaling(rows),
            "memory": self._memory(),
        }

    def _memory(self) -> dict[str, Any]:
        """Bytes per environment: of the state, and of a process's peak as the batch grows."""
        batches, growth = self.config.memory_batches, None
        if self.memory:
            cases = (self._case("memory", ENVIRONMENT, EAGER, "cpu", 1, batch) for batch in batches)
            growth = growth_per_environment(*cases)
        state = Scenario.of(self.config).build(EAGER, "cpu", 2).reset()
        return {
            "vehicles": self.config.env.vehicles,
            "state_bytes": sum(
                leaf.nbytes for leaf in state.values(include_nested=True, leaves_only=True)
            )
            / 2,
            "batches": list(batches),
            "peak_growth_bytes": growth,
        }

    def tables(self, rows: Sequence[Row], findings: Mapping[str, Any]) -> list[Table]:
        """Speed, ratios, growth, memory in kB of 1000 bytes."""
        speed = ("system", "mode", "device", "threads", "batch", "physics steps/s")
        more, peer = (
            ("decisions/s", "vehicle-steps/s", "physics steps/CPU-s"),
            ("times the peer", "in CPU time"),
        )
        columns: dict[str, Callable[[Mapping[str, Any]], str]] = {
            "system": lambda row: row["system"],
            "with the": lambda row: row["in"],
            "sizes": lambda row: ", ".join(map(str, row["sizes"])),
            "ms per decision": lambda row: ", ".join(map(significant, row["milliseconds"])),
            "exponent": lambda row: (
                NOTHING if row["exponent"] is None else f"{row['exponent']:.2f}"
            ),
        }
        memory = findings["memory"]
        kilobytes = [["state, observation included", f"{memory['state_bytes'] / 1000:.2f}"]]
        if memory["peak_growth_bytes"] is not None:
            batches = " and ".join(map(str, memory["batches"]))
            growth = f"{memory['peak_growth_bytes'] / 1000:.2f}"
            kilobytes.append([f"growth of a process's peak between batches {batches}", growth])
        rows = [row for row in rows if row["part"] == "speed"]
        return [
            speed_table(
                "Speed", rows, [*speed, *more, *peer, "spread", "peak memory, MB"], names=3
            ),
            speed_table(
                "The best against HighwayEnv", findings["ratios"], [*speed, *peer], names=3
            ),
            Table.of("Growth of the cost", findings["scaling"], columns, 2),
            Table(
                f"Memory per environment of {memory['vehicles']} vehicles",
                ["what", "kB"],
                kilobytes,
            ),
        ]


def scaling(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Per question and system the ``exponent`` of the cost of a decision (1: linear; None with
    fewer than two sizes).

    With the ``sizes`` and the ``milliseconds`` of wall time that a decision of the whole batch
    took.
    """
    found = []
    for part in ("batch", "vehicles"):
        for system in _START:
            chosen = [row for row in rows if (row["part"], row["system"]) == (part, system)]
            sizes = [row[part] for row in chosen]
            cost = [1000 * row["wall_s"] / (row["decisions"] / row["batch"]) for row in chosen]
            if chosen:
                growth = {"sizes": sizes, "milliseconds": cost, "exponent": exponent(sizes, cost)}
                found.append({"in": part, "system": system, **growth})
    return found


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float | None:
    """``p`` of the least-squares fit ``cost ~ size ** p``; None with fewer than two sizes."""
    if len(set(sizes)) < 2:
        return None
    return float(
        np.polyfit(np.log(np.asarray(sizes, float)), np.log(np.asarray(costs, float)), 1)[0]
    )


class TrafficSuite(Suite):
    """Per number of threads and batch all traffics in all modes, in turns."""

    name = "traffic"

    def groups(self) -> list[Group]:
        """One group per number of threads and batch."""
        return [
            Group(f"threads {threads}, batch {batch}", threads, self.cases(threads, batch))
            for threads in self.config.threads
            for batch in self.config.traffic_batches
        ]

    def cases(self, threads: int, batch: int) -> list[Case]:
        """The cases of a group; the road is kept full, except in replayed traffic."""
        cases = []
        for name, traffic in self.config.chosen_traffics().items():
            env = (
                self.config.env
                if traffic.label() == "replay"
                else replace(self.config.env, recycle=True)
            )
            scenario = Scenario(
                env, traffic, ObservationConfig(), RewardParameters(), self.config.seed
            )
            for mode in self.config.modes:
                labels = self.labels(TRAFFIC, name, mode, threads, batch)
                cases.append(Case(labels, partial(start_traffic, scenario, mode, batch)))
        return cases

    def findings(self, rows: Sequence[Row]) -> dict[str, Any]:
        """``speeds``: the best row of each traffic."""
        return {"speeds": best_rows(rows, "physics_steps_per_s")}

    def tables(self, rows: Sequence[Row], findings: Mapping[str, Any]) -> list[Table]:
        """All rows."""
        headings = ["system", "traffic", "mode", "threads", "batch"]
        headings += ["physics steps/s", "vehicle-steps/s", "physics steps/CPU-s", "spread"]
        return [speed_table("Speed of the traffic", rows, headings, names=3)]


class TrainSuite(Suite):
    """Per device, number of threads and batch all traffics in all modes, in turns with the peer."""

    name = "train"

    def __init__(self, config: BenchConfig) -> None:
        super().__init__(config)
        installed = [installed_version(name) for name in ("stable-baselines3", "highway-env")]
        self.has_peer = config.peers and None not in installed
        if config.peers and not self.has_peer:
            self.notes.append(
                "stable-baselines3 or HighwayEnv is not installed, so there is no DQN to compare with; "
                '`pip install "ganlane[bench]"` brings both.'
            )

    def groups(self) -> list[Group]:
        """One group per device, number of threads and batch."""
        config, agent = self.config, self.config.agent.for_phase(1)
        groups = []
        for device, threads in self.places():
            for batch in config.train_batches:
                cases = []
                for name, traffic in config.chosen_train_traffics().items():
                    training = Training(Scenario.of(config, traffic), agent, config.train_stored)
                    for mode in config.modes:
                        labels = self.labels(TRAINING, name, mode, threads, batch, device=device)
                        cases.append(
                            Case(labels, partial(start_training, training, mode, device, batch))
                        )
                title = f"{device}, threads {threads}, {batch} environments"
                groups.append(
                    Group(title, threads, cases, self.peer(threads) if self.has_peer else None)
                )
        return groups

    def peer(self, threads: int) -> Case:
        """The peer on the suite's road; its network uses torch's threads."""
        config = self.config
        learner, simulator = (
            installed_version("stable-baselines3"),
            installed_version("highway-env"),
        )
        name = f"stable-baselines3 {learner} DQN on HighwayEnv {simulator}"
        labels = self.labels(name, _THEIR_TRAFFIC, EAGER, threads, 1)
        return Case(
            labels, partial(BaselinesRunner, config.env, config.agent.for_phase(1), config.seed)
        )

    def findings(self, rows: Sequence[Row]) -> dict[str, Any]:
        """``speeds``: per device and traffic the row with the most decisions per second.

        ``times_peer`` is the ratio of its decisions per second to the peer's best; None without a
        peer.
        """
        peer = max(
            (row["decisions_per_s"] for row in rows if row["system"] != TRAINING), default=None
        )
        best = best_rows([row for row in rows if row["system"] == TRAINING], "decisions_per_s")
        return {
            "speeds": [
                {**row, "times_peer": row["decisions_per_s"] / peer if peer else None}
                for row in best
            ]
        }

    def tables(self, rows: Sequence[Row], findings: Mapping[str, Any]) -> list[Table]:
        """The best rows, then all."""
        names = ["traffic", "mode", "device", "threads", "environments"]
        columns = {name: COLUMNS[name] for name in (*names, "decisions/s")}
        columns["times the peer"] = lambda row: significant(row["times_peer"])
        note = "Each at its best mode, number of threads and number of environments."
        headings = ["system", *names, "decisions/s", "physics steps/s", "decisions/CPU-s", "spread"]
        return [
            Table.of("Decisions per second with learning", findings["speeds"], columns, 3, [note]),
            speed_table("Training in every mode", rows, headings, names=4),
        ]
