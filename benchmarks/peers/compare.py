"""Drive every scene in every simulator and measure the differences.

    python -m benchmarks.peers.compare

Prints the tables of docs/peers.md, writes them there, and writes docs/figures/peers.json and
docs/figures/peers.png. What separates a peer's trace from ganlane's is taken apart into three
pieces:

- ``law``: our own driver under the peer's reading of IDM, less ganlane;
- ``scheme``: the peer, less our own driver under the peer's reading.
  :mod:`benchmarks.peers.tolerance` bounds it;
- ``rest``: the peer, less our own driver under the peer's reading and the peer's scheme. Only
  rounding may remain.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any, NamedTuple

from benchmarks.peers.report import PARTS, draw
from benchmarks.peers.scene import (
    OBSTACLE,
    SCENES,
    SETTLED_MPS,
    SLOW_AND_GO,
    Scene,
    Scheme,
    Trace,
    equilibrium_gap,
    integrate,
    settling,
)
from benchmarks.peers.simulators import (
    OURS,
    PEERS,
    Peer,
    drive_highway_env,
    drive_ours,
    drive_sumo,
    require_peers,
    versions,
)
from benchmarks.peers.tolerance import Largest, between, largest, tolerance, unsettled_gap_m
from benchmarks.script import ROOT, ReportSection, make_parser, run_script
from ganlane.files import write_json

DOCS = ROOT / "docs"


class Apart(NamedTuple):
    """What separates a peer from ganlane in one scene, and what the scheme may account for."""

    direct: Largest
    law: Largest
    scheme: Largest
    allowed: Largest
    rest: Largest


def take_apart(scene: Scene, peer: Peer, ganlane: Trace, driven: Trace) -> Apart:
    """Law, scheme and rest of the difference between ``driven`` (the peer's trace) and
    ``ganlane``'s.
    """
    read = integrate(scene, Scheme.BALLISTIC, peer.law)
    return Apart(
        direct=between(driven, ganlane),
        law=between(read, ganlane),
        scheme=between(driven, read),
        allowed=tolerance(read, scene, peer.scheme, peer.law),
        rest=between(driven, integrate(scene, peer.scheme, peer.law)),
    )


def settled(speed_mps: float, simulator: Peer) -> dict[str, float]:
    """The last gaps of a platoon.

    Their mean, how far one is from the formula of its law, and how far it may be.
    """
    trace = simulator.drive(settling(speed_mps))
    expected = equilibrium_gap(speed_mps, simulator.law)
    return {
        "gap_m": float(trace.gap[-1].mean()),
        "formula_m": expected,
        "away_m": largest(trace.gap[-1] - expected),
        "allowed_m": unsettled_gap_m(trace, simulator.law),
    }


def collect() -> tuple[dict[str, Any], dict[str, dict[str, Trace]]]:
    """All figures, and the traces by scene and simulator."""
    traces: dict[str, dict[str, Trace]] = {}
    rows: list[dict[str, Any]] = []
    simulators = (OURS, *PEERS)
    for scene in SCENES:
        driven = {simulator.name: simulator.drive(scene) for simulator in simulators}
        traces[scene.name] = driven
        for peer in PEERS:
            apart = take_apart(scene, peer, driven[OURS.name], driven[peer.name])._asdict()
            pieces = {name: piece._asdict() for name, piece in apart.items()}
            rows.append({"scene": scene.name, "peer": peer.name, **pieces})
    figures = {
        "versions": versions(),
        "traces": rows,
        "settled": [
            {"speed_mps": speed, "simulator": simulator.name, **settled(speed, simulator)}
            for speed in SETTLED_MPS
            for simulator in simulators
        ],
        "stops": [
            {
                "simulator": name,
                "final_gap_m": float(trace.gap[-1, 0]),
                "lowest_mps": float(trace.speed[:, 1].min()),
            }
            for name, trace in traces[OBSTACLE.name].items()
        ],
        "steps": _steps(),
        # At steps of a millisecond the final gap is the model's own.
        "final_gap_at_1_ms_m": float(integrate(OBSTACLE, Scheme.BALLISTIC, dt=0.001).gap[-1, 0]),
    }
    return figures, traces


def _steps() -> list[dict[str, Any]]:
    """What the step itself does in the scene 'slow and go'.

    Every simulator against ganlane at 0.1 s.
    """
    scene = SLOW_AND_GO
    mine = drive_ours(scene)
    # A trace, and every how many of its moments and of ganlane's they are at one time.
    others = {
        "its own equations at 0.01 s": (integrate(scene, Scheme.BALLISTIC, dt=0.01), 10, 1),
        "HighwayEnv at its default 1/15 s": (drive_highway_env(scene, dt=1 / 15), 3, 2),
        "SUMO at its default 1 s, Euler": (drive_sumo(scene, ballistic=False, dt=1.0), 1, 10),
        "SUMO at 1 s, ballistic": (drive_sumo(scene, dt=1.0), 1, 10),
    }
    return [
        {"other": name, **between(every(other, its), every(mine, ours))._asdict()}
        for name, (other, its, ours) in others.items()
    ]


def every(trace: Trace, stride: int) -> Trace:
    """One moment in ``stride``."""
    return Trace(trace.speed[::stride], trace.position[::stride])


def write(options: argparse.Namespace) -> str:
    """Measure, write JSON and plot, and the tables into the page; the tables.

    Raises:
        UserError: HighwayEnv or SUMO is not installed.
    """
    require_peers()
    sections = {name: ReportSection(DOCS / "peers.md", f"peers {name}") for name in PARTS}
    figures, traces = collect()
    tables = {name: part(figures) for name, part in PARTS.items()}
    write_json(DOCS / "figures" / "peers.json", figures)
    draw(traces, figures, DOCS / "figures" / "peers.png")
    for name, table in tables.items():
        sections[name].write(table)
    return "\n\n".join(tables.values())


if __name__ == "__main__":
    sys.exit(run_script(write, make_parser(__doc__).parse_args()))
