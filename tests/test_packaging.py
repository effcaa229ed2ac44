"""The contents of an installed package."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path

import pytest

import ganlane
from ganlane.agents.checkpoint import SHIPPED
from ganlane.files import PACKAGE, conf_folder
from ganlane.native import library

if sys.version_info >= (3, 11):
    import tomllib
else:  # pragma: no cover
    tomllib = pytest.importorskip("tomli")

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_the_version_stands_in_one_place():
    assert PROJECT["project"]["dynamic"] == ["version"]
    stated = ROOT / PROJECT["tool"]["hatch"]["version"]["path"]
    assert f'__version__ = "{ganlane.__version__}"' in stated.read_text()
    assert f"## [{ganlane.__version__}]" in (ROOT / "CHANGELOG.md").read_text()


def test_the_console_script_is_the_dispatcher():
    assert PROJECT["project"]["scripts"]["ganlane"] == "ganlane.__main__:main"


def test_a_checkouts_conf_comes_before_a_copy_inside():
    assert conf_folder() == PACKAGE.parent / "conf"


def test_a_conf_folder_of_another_project_is_not_ours(tmp_path, monkeypatch):
    (tmp_path / "conf").mkdir()
    inside = tmp_path / "package" / "conf"
    (inside / "traffic").mkdir(parents=True)
    for name in ("train.yaml", "traffic/gan.yaml"):
        (inside / name).touch()
    monkeypatch.setattr("ganlane.files.PACKAGE", tmp_path / "package")
    assert conf_folder() == inside


def files_of_wheel(folder, monkeypatch):
    """Names in a wheel and its bytes.

    Built with one variant of the kernel, since the others take seconds.
    """
    monkeypatch.setattr(library, "VARIANTS", {"default": library.VARIANTS["default"]})
    wheel = pytest.importorskip(
        "hatchling.builders.wheel", reason="hatchling is not installed; CI builds the wheel"
    )
    (artifact,) = map(
        Path, wheel.WheelBuilder(str(ROOT)).build(directory=str(folder), versions=["standard"])
    )
    assert artifact.name.startswith(f"ganlane-{ganlane.__version__}-")
    with zipfile.ZipFile(artifact) as packed:
        return set(packed.namelist()), artifact.stat().st_size


def test_a_light_wheel_leaves_the_further_trainings_out_and_is_below_5_mb(tmp_path, monkeypatch):
    monkeypatch.setenv("GANLANE_LIGHT_WHEEL", "1")
    names, size = files_of_wheel(tmp_path, monkeypatch)
    weights = {path.name for path in (PACKAGE / "checkpoints").glob("*.safetensors")}
    inside = {name.rpartition("/")[2] for name in names if name.endswith(".safetensors")}
    assert weights - inside == {f"seeds_of_{agent}.safetensors" for agent in SHIPPED}
    assert size < 5e6


def test_the_wheel_holds_configuration_weights_and_kernel(tmp_path, monkeypatch):
    names, _ = files_of_wheel(tmp_path, monkeypatch)
    assert {
        f"ganlane/conf/{path.relative_to(ROOT / 'conf')}"
        for path in (ROOT / "conf").rglob("*.yaml")
    } <= names
    for kind in ("safetensors", "json"):
        shipped = {
            f"ganlane/checkpoints/{path.name}"
            for path in (PACKAGE / "checkpoints").glob(f"*.{kind}")
        }
        assert shipped
        assert shipped <= names
    page = {
        f"ganlane/view/player_page/{path.name}"
        for path in (PACKAGE / "view" / "player_page").iterdir()
    }
    assert "ganlane/view/player_page/page.html" in page <= names
    assert "ganlane/py.typed" in names
    assert "ganlane_simulators/sumo.py" in names
    kernels = [name for name in names if name.startswith("ganlane/native/prebuilt/kernel-default-")]
    assert len(kernels) == (1 if library.find_compiler() else 0)
    assert not [name for name in names if name.startswith(("tests/", "outputs/"))]
