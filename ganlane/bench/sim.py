"""``suite=sim``: how fast the simulator is, how its cost grows, its memory, compared with HighwayEnv."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ganlane.bench.measure import (
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
    GymnasiumRunner,
    Scenario,
    highway_env_case,
    installed_version,
    start_environment,
    start_envpool,
    start_physics,
)
from ganlane.build import make_traffic
from ganlane.config.commands import BenchConfig
from ganlane.config.env import DenseEnvConfig, EnvConfig
from ganlane.evaluation.table import NOTHING, Table, significant

PHYSICS, ENVIRONMENT, GYMNASIUM = "ganlane physics", "ganlane environment", "ganlane gymnasium"
_START: dict[str, Any] = {PHYSICS: start_physics, ENVIRONMENT: start_environment, GYMNASIUM: GymnasiumRunner}
_MISSING = (
    "HighwayEnv is not installed, so there are no ratios to it; "
    '`pip install "ganlane[bench]"` (or `pip install highway-env`) brings it.'
)
_HEADINGS = (
    *("system", "mode", "device", "threads", "batch", "physics steps/s", "decisions/s", "vehicle-steps/s"),
    *("physics steps/CPU-s", "times the peer", "in CPU time", "spread", "peak memory, MB"),
)
_GROWTH: dict[str, Callable[[Mapping[str, Any]], str]] = {
    "system": lambda row: row["system"],
    "with the": lambda row: row["in"],
    "sizes": lambda row: ", ".join(map(str, row["sizes"])),
    "ms per decision": lambda row: ", ".join(map(significant, row["milliseconds"])),
    "exponent": lambda row: NOTHING if row["exponent"] is None else f"{row['exponent']:.2f}",
}
_AGAINST = ("system", "mode", "device", "threads", "batch", "physics steps/s", "times the peer", "in CPU time")


class SimSuite(Suite):
    """Speed at every batch; growth of the cost with the batch and with the vehicles, eager; memory."""

    name = "sim"

    def __init__(self, config: BenchConfig) -> None:
        recycle = not make_traffic(config.traffic, config.env).own_roads
        super().__init__(replace(config, env=replace(config.env, recycle=recycle)))
        self.memory = config.memory
        if not recycle:
            self.notes.append("Not recycled: recorded vehicles go where they went, so the road empties.")
        self.has_peer = config.peers and installed_version("highway-env") is not None
        if config.peers and not self.has_peer:
            self.notes.append(_MISSING)
        self.has_envpool = config.peers and installed_version("envpool") is not None
        # A scene set by hand has as many vehicles as it has.
        self.grows = type(config.env) in (EnvConfig, DenseEnvConfig)
        if not self.grows:
            self.notes.append("Not measured: growth with the vehicles; their number belongs to the scene.")

    def groups(self) -> list[Group]:
        """Speed at every batch in turns with HighwayEnv; growth with the batch and with the vehicles."""
        reference = highway_env_case(self) if self.has_peer else None
        speed = [
            Group(
                f"{device}, threads {threads}, batch {batch}",
                threads,
                [
                    self._case("speed", system, mode, device, threads, batch)
                    for system in _START
                    for mode in self.config.modes
                    if system != GYMNASIUM or (mode == NATIVE and device == "cpu")
                ]
                + ([self._envpool(threads, batch)] if self.has_envpool and device == "cpu" else []),
                reference,
            )
            for device, threads in self.places()
            for batch in self.config.batches
        ]
        growth = [group for system in (PHYSICS, ENVIRONMENT) for group in self._growth(system)]
        return speed + [group for group in growth if len(group.cases) > 1]

    def _envpool(self, threads: int, batch: int) -> Case:
        """HighwayEnv in C++ on the suite's road."""
        name = f"EnvPool {installed_version('envpool')}"
        labels = self.labels(name, "its IDM and MOBIL", NATIVE, threads, batch)
        return Case(labels, partial(start_envpool, self.config.env, batch, threads, self.config.seed))

    def _growth(self, system: str) -> list[Group]:
        """Sizes side by side, on the first device."""
        config = self.config
        device, threads = config.chosen_devices()[0], config.threads[0]
        large = [batch for batch in config.batches if batch >= config.linear_from]
        counts = config.vehicle_counts if self.grows else []
        batches = [self._case("batch", system, EAGER, device, threads, batch) for batch in large]
        vehicles = [
            self._case("vehicles", system, EAGER, device, threads, config.scaling_batch, number) for number in counts
        ]
        return [
            Group(f"{system}, growth with the batch", threads, batches),
            Group(f"{system}, growth with the vehicles", threads, vehicles),
        ]

    def _case(
        self, part: str, system: str, mode: str, device: str, threads: int, batch: int, vehicles: int | None = None
    ) -> Case:
        """With so many ``vehicles`` the first scene grows to keep the density of Table II.

        It is then wider than the range of recycling, which would crowd it; in so short a time no ego leaves it.
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
        """``ratios``: each system's best row against the peer; ``scaling``; ``memory`` per environment."""
        compared = [row for row in rows if row["system"] in _START and row["ratio"] is not None]
        return {"ratios": best_rows(compared, "ratio"), "scaling": scaling(rows), "memory": self._memory()}

    def _memory(self) -> dict[str, Any]:
        """Bytes per environment: of the state, and of a process's peak as the batch grows."""
        batches, growth = self.config.memory_batches, None
        if self.memory:
            cases = (self._case("memory", ENVIRONMENT, EAGER, "cpu", 1, batch) for batch in batches)
            growth = growth_per_environment(*cases)
        state = Scenario.of(self.config).build(EAGER, "cpu", 2).reset()
        return {
            "vehicles": self.config.env.vehicles,
            "state_bytes": sum(leaf.nbytes for leaf in state.values(include_nested=True, leaves_only=True)) / 2,
            "batches": list(batches),
            "peak_growth_bytes": growth,
        }

    def tables(self, rows: Sequence[Row], findings: Mapping[str, Any]) -> list[Table]:
        """Speed, ratios, growth, memory in kB of 1000 bytes."""
        memory = findings["memory"]
        kilobytes = [["state, observation included", f"{memory['state_bytes'] / 1000:.2f}"]]
        if memory["peak_growth_bytes"] is not None:
            batches = " and ".join(map(str, memory["batches"]))
            growth = f"{memory['peak_growth_bytes'] / 1000:.2f}"
            kilobytes.append([f"growth of a process's peak between batches {batches}", growth])
        return [
            speed_table("Speed", [row for row in rows if row["part"] == "speed"], _HEADINGS, names=3),
            speed_table("The best against HighwayEnv", findings["ratios"], _AGAINST, names=3),
            Table.of("Growth of the cost", findings["scaling"], _GROWTH, 2),
            Table(f"Memory per environment of {memory['vehicles']} vehicles", ["what", "kB"], kilobytes),
        ]


def scaling(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Per question and system the ``exponent`` of the cost of a decision (1: linear; None with fewer than two sizes).

    With the ``sizes`` and the ``milliseconds`` of wall time that a decision of the whole batch took.
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
    return float(np.polyfit(np.log(np.asarray(sizes, float)), np.log(np.asarray(costs, float)), 1)[0])
