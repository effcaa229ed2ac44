"""The realism card as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

_NOTHING = "-"
#: The check of a guard, and its answer where there is none.
_GUARD, _WITHOUT_GUARD = "guard_under_5_percent", "no guard"


def _number(value: float | None, digits: int = 3) -> str:
    return _NOTHING if value is None else f"{value:.{digits}f}"


def short_name(traffic: str) -> str:
    """A traffic's name without the path that it is imported from."""
    return traffic.rpartition(".")[2]


def _with_interval(row: Mapping[str, Any], name: str, digits: int = 3) -> str:
    interval = row.get(f"{name}_ci")
    text = _number(row.get(name), digits)
    return text if not interval else f"{text} [{interval[0]:.{digits}f}, {interval[1]:.{digits}f}]"


def _aligned(lines: Sequence[Sequence[str]]) -> str:
    """Columns side by side, the first to the left and the others to the right, the first line ruled off."""
    widths = [max(map(len, column)) for column in zip(*lines)]

    def aligned(line: Sequence[str]) -> str:
        first, *rest = (cell.rjust(width) for cell, width in zip(line, widths))
        return "  ".join([first.strip().ljust(widths[0]), *rest]).rstrip()

    return "\n".join([aligned(lines[0]), "  ".join("-" * width for width in widths), *map(aligned, lines[1:])])


def quantities_table(quantities: Mapping[str, Any], traffic: str) -> str:
    """Distances, one quantity a line: the traffic, the scale, and the others with the difference to each."""
    others = list(next(iter(quantities.values()))["against"])
    heading = ["distance to recorded", f"{short_name(traffic)} [95 %]", "ceiling", "constant v", "random"]
    for other in others:
        heading += [short_name(other), f"minus {short_name(other)} [95 %]", ""]
    lines = [heading]
    for name, row in quantities.items():
        scale = (_number(row[key]) for key in ("ceiling", "constant_velocity", "floor"))
        line = [f"{name}, {row['unit']}", _with_interval(row, "distance"), *scale]
        for other in others:
            rival = row["against"][other]
            line += [_number(rival["distance"]), _with_interval(rival, "difference"), rival["verdict"]]
        lines.append(line)
    return _aligned(lines)


def starts_table(driving: Mapping[str, Any]) -> str:
    """Lane changes and accelerations of everybody, one driver a line; the recording among them."""
    lines = [["from the same starts", "changes per vehicle-km [95 %]", "vehicle-km", "acceleration 5 %, 95 %"]]
    for name, row in driving.items():
        low, high = (row["quantiles"]["acceleration"][level] for level in ("0.05", "0.95"))
        rate = _with_interval(row, "per_vehicle_km", 2)
        lines.append(
            [short_name(name), rate, _number(row["vehicle_km"], 1), f"{_number(low, 2)}, {_number(high, 2)}"]
        )
    return _aligned(lines)


def long_table(runs: Sequence[Mapping[str, Any]], traffic: str) -> str:
    """The long runs of a traffic, one column each."""
    rows: list[list[str]] = [[f"{short_name(traffic)}, long runs", *(f"{run['vehicles']} vehicles" for run in runs)]]
    plain = ("off_road", "standstills_in_free_flow")
    rows.append(["vehicle-km", *(_number(run["vehicle_km"], 0) for run in runs)])
    rows.append(["changes per vehicle-km", *(_with_interval(run, "lane_changes_per_vehicle_km", 2) for run in runs)])
    rows.append(
        ["overlaps per 1000 vehicle-km", *(_with_interval(run, "overlaps_per_1000_vehicle_km", 2) for run in runs)]
    )
    rows += [[name.replace("_", " "), *(str(run[name]) for run in runs)] for name in plain]
    for time in runs[0]["speeds"]:
        at = [run["speeds"][time] for run in runs]
        cells = [f"{_number(each['mean_speed_mps'], 1)}, {_number(each['spread_mps'], 2)}" for each in at]
        rows.append([f"mean speed, spread after {time}, m/s", *cells])
    for level in runs[0]["acceleration_quantiles"]:
        cells = [_number(run["acceleration_quantiles"][level], 2) for run in runs]
        rows.append([f"acceleration, {100 * float(level):g} % quantile", *cells])
    shares = ["none" if run["guard_share"] is None else f"{100 * run['guard_share']:.1f} %" for run in runs]
    rows.append(["the guard's share", *shares])
    return _aligned(rows)


def checks_text(checks: Mapping[str, Any]) -> str:
    """The card's checks, a line each."""
    words = {True: "yes", False: "no", None: "not told"}
    near = "acceleration_quantiles_within_30_percent"
    lines = [f"{near.replace('_', ' ')}: {words[checks[near]]}"]
    for other, verdicts in checks["compared_with"].items():
        lines.append(
            f"than {short_name(other)}: " + ", ".join(f"{name} {verdict}" for name, verdict in verdicts.items())
        )
    for run in checks["long_runs"]:
        told = ", ".join(
            f"{name.replace('_', ' ')}: {_WITHOUT_GUARD if name == _GUARD and value is None else words[value]}"
            for name, value in run.items()
            if name != "vehicles"
        )
        lines.append(f"{run['vehicles']} vehicles: {told}")
    return "\n".join(lines)
