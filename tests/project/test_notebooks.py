"""The notebooks of the examples run from top to bottom in a kernel, and show their results."""

from pathlib import Path

import pytest

pytest.importorskip("nbclient", reason="pip install -e '.[ci]'")

import nbformat
from arms import MISSING
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

pytestmark = pytest.mark.full
NOTEBOOKS = sorted((Path(__file__).parents[2] / "examples" / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_shows_its_results(path: Path, tmp_path: Path, monkeypatch):
    notebook = nbformat.read(path, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "outputs are not tracked"
    monkeypatch.delenv("MPLBACKEND", raising=False)  # a kernel chooses its own, which shows figures below the cell
    try:
        NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    except CellExecutionError as error:
        if MISSING in str(error):
            pytest.skip(MISSING)
        raise
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.outputs for cell in cells if not cell.source.startswith("import"))
    kinds = {kind for cell in cells for output in cell.outputs for kind in output.get("data", {})}
    assert ("image/png" in kinds) == any(word in cell.source for cell in cells for word in (".plot", "overlay"))
    shown_as_html = ("scene", "sim.arm", "report\n", "record", "compare(")
    assert ("text/html" in kinds) == any(word in f"{cell.source}\n" for cell in cells for word in shown_as_html)
