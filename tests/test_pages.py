# SPDX-License-Identifier: MIT
"""The reference has all public names, its pages are there, and scripts become notebooks."""

import contextlib
import inspect
import re
import sys
from pathlib import Path

import pytest

import mpm_dolfinx as mpm

ROOT = Path(__file__).parent.parent
HERE = ROOT / "demos" / "reference"
sys.path.insert(0, str(HERE))


def test_the_reference_has_each_public_name_once():
    texts = [path.read_text() for path in (HERE / "pages").glob("*.md")]
    named = [name for text in texts for name in re.findall(r"^::: mpm_dolfinx\.(\w+)$", text, re.M)]
    assert sorted(named) == sorted(mpm.__all__)


def test_what_the_reference_names_by_module_is_there():
    for text in (path.read_text() for path in (HERE / "pages").glob("*.md")):
        for module, name in re.findall(r"^::: (mpm_dolfinx\.[\w.]+)\.(\w+)$", text, re.M):
            assert hasattr(__import__(module, fromlist=[name]), name)


def test_pages_of_the_menu_are_laid_with_the_files_that_they_link_to(tmp_path):
    import pages

    pages.lay(tmp_path)
    menu = re.findall(r": ([\w/]+\.md)$", (HERE / "mkdocs.yml").read_text(), re.M)
    assert len(menu) >= 12 and {*menu} == {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.md")}
    for name in menu:
        page = (tmp_path / name).read_text()
        links = re.findall(r"\]\(([^)#]+)", page) + re.findall(r'src="([^"]+)"', page)
        for link in links:
            assert link.startswith("http") or (tmp_path / name).parent.joinpath(link).exists(), (name, link)
    assert (tmp_path / "tutorial.md").read_text().count("\n## ") == 6


def test_names_beside_words_of_other_programs_are_there():
    section = (ROOT / "demos/README.md").read_text().partition("## Words of other programs\n")[2].partition("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("| ")][1:]
    code = [each for row in rows for each in re.findall(r"`([^`]+)`", row)]
    parameters = set()
    for name in mpm.__all__:
        if callable(value := getattr(mpm, name)):
            with contextlib.suppress(ValueError):
                parameters |= {*inspect.signature(value).parameters}
    parameters |= {
        *inspect.signature(mpm.Simulation.run).parameters,
        *inspect.signature(mpm.Simulation.stage).parameters,
    }
    assert len(rows) > 25 and len(code) > 50
    for each in code:
        found = [hasattr(mpm, name) for name in re.findall(r"\bmpm\.(\w+)", each)]
        found += [hasattr(mpm.Simulation, name) for name in re.findall(r"\bsimulation\.(\w+)", each)]
        found += [name in parameters for name in re.findall(r"\b(\w+)=", each)]
        assert found and all(found), each


def test_scripts_become_notebooks_with_text_and_code(tmp_path):
    pytest.importorskip("jupytext")
    import json

    import notebooks

    files = notebooks.write(tmp_path)
    assert len(files) == 4
    for file in files:
        cells = json.loads(file.read_text())["cells"]
        assert cells[0]["cell_type"] == "markdown" and cells[0]["source"][0].startswith("# ")
        code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
        compile("\n".join(code), str(file), "exec")
        assert "import mpm_dolfinx as mpm" in "\n".join(code)
