"""The contents of an installed package."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from reference.processes import ROOT

import ganlane
from ganlane.agents.checkpoint import SHIPPED
from ganlane.files import PACKAGE, conf_folder
from ganlane.native import library

if sys.version_info >= (3, 11):
    import tomllib
else:  # pragma: no cover
    tomllib = pytest.importorskip("tomli")

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_the_version_stands_in_one_place():
    assert PROJECT["project"]["dynamic"] == ["version"]
    stated = ROOT / PROJECT["tool"]["hatch"]["version"]["path"]
    assert f'__version__ = "{ganlane.__version__}"' in stated.read_text()
    assert f"## [{ganlane.__version__}]" in (ROOT / "CHANGELOG.md").read_text()
    assert f"\nversion: {ganlane.__version__}\n" in (ROOT / "CITATION.cff").read_text()


def test_a_conf_folder_of_another_project_is_not_ours(tmp_path, monkeypatch):
    (tmp_path / "conf").mkdir()
    inside = tmp_path / "package" / "conf"
    (inside / "traffic").mkdir(parents=True)
    for name in ("train.yaml", "traffic/gan.yaml"):
        (inside / name).touch()
    monkeypatch.setattr("ganlane.files.PACKAGE", tmp_path / "package")
    assert conf_folder() == inside


#: Endings and names of the files in the repository's root.
KINDS = {".md", ".toml", ".yml", ".yaml", ".cff", ".bib", ".py"}
NAMES = {"LICENSE", "Dockerfile", ".gitignore", ".dockerignore"}


def test_the_root_holds_no_files_of_unexpected_kinds():
    git = ["git", "-C", str(ROOT), "ls-files"]
    listed = subprocess.run(git, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("this is no checkout")
    names = {name for name in listed.stdout.splitlines() if "/" not in name}
    assert {name for name in names - NAMES if Path(name).suffix not in KINDS} == set()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A built wheel, with something in place of the kernel, whose compiling takes seconds."""

    def build_all(folder: Path) -> tuple[list[Path], list[str]]:
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / library._prebuilt("default").name
        path.write_bytes(b"a library")
        return [path], []

    builder = pytest.importorskip(
        "hatchling.builders.wheel", reason="hatchling is not installed; CI builds the wheel"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(library, "build_all", build_all)
        folder = str(tmp_path_factory.mktemp("wheel"))
        (path,) = builder.WheelBuilder(str(ROOT)).build(directory=folder, versions=["standard"])
    return Path(path)


def test_the_wheel_holds_configuration_weights_and_kernel_and_is_below_6_8_mb(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    conf = ROOT / "conf"
    inside = {f"ganlane/conf/{path.relative_to(conf)}" for path in conf.rglob("*.yaml")}
    for folder in ("checkpoints", "view/player_page"):
        inside |= {f"ganlane/{folder}/{path.name}" for path in (PACKAGE / folder).iterdir()}
    further = {f"ganlane/checkpoints/seeds_of_{agent}.safetensors" for agent in SHIPPED}
    assert {*inside, "ganlane/py.typed"} - names == further
    kernels = [name for name in names if name.startswith("ganlane/native/prebuilt/kernel-default-")]
    assert len(kernels) == 1
    assert not [name for name in names if name.startswith(("tests/", "outputs/"))]
    assert wheel.name.startswith(f"ganlane-{ganlane.__version__}-")
    # Four agents of 1.4 MB are most of it.
    assert wheel.stat().st_size < 6.8e6
