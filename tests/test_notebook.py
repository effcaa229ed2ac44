"""The notebook in examples/ runs from its first cell to its last, and the outputs that it is stored
with are whole.
"""

import os

import pytest
from reference.processes import ROOT

nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")
nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")
pytest.importorskip("ipykernel", reason="ipykernel is not installed")

NOTEBOOK = ROOT / "examples" / "quickstart.ipynb"


def shown(notebook):
    """What its code cells show, by MIME type."""
    outputs = [
        output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs
    ]
    assert not [output for output in outputs if output.output_type == "error"]
    data = [output.data for output in outputs if "data" in output]
    return {
        kind: [output[kind] for output in data if kind in output]
        for kind in ("text/plain", "text/html", "image/png")
    }


def test_the_notebook_leads_to_tables_and_a_picture(tmp_path, monkeypatch):
    monkeypatch.setenv(
        "PYTHONPATH", os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    )
    stored = nbformat.read(NOTEBOOK, as_version=4)
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(
        notebook, timeout=120, kernel_name="python3", resources=resources
    ).execute()
    for outputs in (shown(notebook), shown(stored)):
        assert outputs["text/plain"][0].startswith("'after 1 s: 4")
        assert ["hurried" in table for table in outputs["text/html"]] == [False, True]
        assert len(outputs["image/png"]) == 1
    assert (tmp_path / "strip.png").stat().st_size > 10_000


def test_it_is_kept_without_the_paths_of_a_machine():
    assert "/work" not in NOTEBOOK.read_text()
    assert "/home" not in NOTEBOOK.read_text()
