"""No module imports one that stands later in the order of the package."""

from __future__ import annotations

import ast
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
    {"parameters"},
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
    {"compare"},
    {"realism", "reproduce", "doctor"},
    {"options"},
    # The typed calls run the commands' own functions.
    {"api"},
    {"gym"},
    {"sb3"},
    {"commands"},
    {"train", "evaluate", "render", "record", "train_generator", "prepare"},
    {"__main__"},
]
LEVEL = {part: level for level, parts in enumerate(ORDER) for part in parts}
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def part_of(path: Path) -> str:
    """``sim`` for ganlane/sim/idm.py, ``env`` for ganlane/env.py."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(path: Path) -> set[str]:
    """Parts of the package that a module imports anywhere, in functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            if node.module == "ganlane":
                found |= {alias.name for alias in node.names}
            elif node.module and node.module.startswith("ganlane."):
                found.add(node.module.split(".")[1])
        elif isinstance(node, ast.Import):
            found |= {
                alias.name.split(".")[1]
                for alias in node.names
                if alias.name.startswith("ganlane.")
            }
    return found - {"__version__"}


def test_every_part_has_its_place():
    assert {part_of(path) for path in MODULES} <= LEVEL.keys()


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_down(path):
    own = part_of(path)
    for other in imported(path) & LEVEL.keys():
        assert other == own or LEVEL[other] < LEVEL[own] or (LEVEL[other] == LEVEL[own] == 0), (
            f"{own} imports {other}"
        )


BELOW_CONFIG = [
    *(
        "parameters",
        "sim",
        "data",
        "generator",
        "traffic",
        "env",
        "transforms",
        "agents",
        "evaluation",
    ),
]


@pytest.mark.parametrize("part", BELOW_CONFIG)
def test_nothing_below_config_knows_hydra(part):
    for path in MODULES:
        if part_of(path) == part:
            assert "hydra" not in path.read_text().lower().replace("hydra's", ""), path
