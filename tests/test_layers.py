"""No module imports one that stands later in the order of the package."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import ganlane

PACKAGE = Path(ganlane.__file__).parent
#: From the bottom up; what stands in one line may import each other's neighbours to the left only
#: within itself.
ORDER = [
    {
        "_version",
        "arguments",
        "keys",
        "errors",
        "files",
        "weights",
        "runtime",
        "torch_settings",
        "linear",
    },
    {"settings"},
    {"data", "sim"},
    {"generator"},
    {"native"},
    {"traffic"},
    {"env"},
    {"transforms"},
    {"agents"},
    {"evaluation"},
    {"view"},
    {"config"},
    {"build"},
    {"training"},
    {"suite"},
    {"realism", "doctor"},
    # The typed calls run the commands' own functions.
    {"api"},
    {"gym"},
    {"sb3"},
    {"commands"},
    {"train"},
    {"__main__"},
]
#: What the environment's record builds, scenes and vehicles, is imported where it is built.
LATE = {("settings", "sim")}
LEVEL = {part: level for level, parts in enumerate(ORDER) for part in parts}
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def part_of(path: Path) -> str:
    """``sim`` for ganlane/sim/idm.py, ``env`` for ganlane/env.py."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(path: Path) -> set[str]:
    """Parts of the package that a module imports anywhere, in functions too."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return {name.split(".")[1] for name in names if name.startswith("ganlane.")} - {"__version__"}


def test_every_part_has_its_place():
    assert {part_of(path) for path in MODULES} <= LEVEL.keys()


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_down(path):
    part = part_of(path)
    for other in imported(path) & LEVEL.keys():
        is_below = LEVEL[other] < LEVEL[part] or LEVEL[other] == LEVEL[part] == 0
        assert other == part or is_below or (part, other) in LATE, f"{part} imports {other}"


#: In one order, as every worker collects the same tests.
BELOW_CONFIG = sorted(part for part, level in LEVEL.items() if 0 < level < LEVEL["config"])


@pytest.mark.parametrize("part", BELOW_CONFIG)
def test_nothing_below_config_knows_hydra(part):
    for path in MODULES:
        if part_of(path) == part:
            assert "hydra" not in path.read_text().lower().replace("hydra's", ""), path


#: Names that say nothing of what they stand for.
EMPTY_NAMES = {"each", "found", "kept", "made", "given", "known", "own"}
PLACES = ("ganlane", "ganlane_simulators", "benchmarks", "tests")


def names_in(path: Path) -> Iterator[tuple[int, str]]:
    """Line and name of every assigned name and every argument of a module."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg


@pytest.mark.parametrize("place", PLACES)
def test_names_say_what_a_thing_is(place):
    empty = [
        f"{path.relative_to(PACKAGE.parent)}:{line}: {name}"
        for path in sorted((PACKAGE.parent / place).rglob("*.py"))
        for line, name in names_in(path)
        if name in EMPTY_NAMES
    ]
    assert empty == []
