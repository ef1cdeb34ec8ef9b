# SPDX-License-Identifier: MIT
"""The code of the pages runs, its names exist, and the figures equal the output of the demos."""

import json
import re
from pathlib import Path

import pytest
import tables
import test_demos

import mpm_dolfinx as mpm

ROOT = Path(__file__).parent.parent
COMMANDS = ("reference", "notebooks")  # of demos/run.sh, beside the demos
PAGES = {name: (ROOT / name).read_text() for name in ("README.md", "demos/README.md", "mpm_dolfinx/README.md")}
BLOCKS = [
    pytest.param(code, id=f"{name.removesuffix('/README.md')}-{k}")
    for name, page in PAGES.items()
    for k, code in enumerate(re.findall(r"```python\n(.*?)```", page, flags=re.S))
]


@pytest.mark.parametrize("code", BLOCKS)
def test_code_blocks_run(code, capsys):
    if "mpm.polygon(" in code:
        pytest.importorskip("gmsh")
    exec(compile(code, "README.md", "exec"), {})
    assert capsys.readouterr().out


@pytest.mark.parametrize("name", PAGES)
def test_named_files_exist(name):
    page, folder = PAGES[name], (ROOT / name).parent
    links = [link.split("#")[0] for link in re.findall(r"\]\(([^)]+)\)", page) + re.findall(r'src="([^"]+)"', page)]
    assert len(links) > 1
    for link in filter(None, links):
        assert link.startswith("http") or (folder / link).exists(), link
    for file in re.findall(r"`([\w/]+\.(?:py|cff|md))`", page):
        assert any((start / file).exists() for start in (ROOT, ROOT / "mpm_dolfinx")) or file == "my_scene.py", file
    for file in re.findall(r"tests/test_\w+\.py", page):
        assert (ROOT / file).exists(), file
    for demo in re.findall(r"demos/run\.sh (?:-n \d )?([a-z][\w/]+)", page):
        assert demo in COMMANDS or (ROOT / "demos" / f"{demo}.py").exists(), demo


def test_the_version_is_everywhere_the_same():
    for file in ("CITATION.cff", ".ci/conda/meta.yaml"):
        assert f"version: {mpm.__version__}\n" in (ROOT / file).read_text(), file


@pytest.mark.parametrize("page", tables.PAGES, ids=["front", "demos"])
def test_figures_are_those_that_the_demos_have_printed(page):
    text = page.read_text()
    assert tables.written(text) == text, "bash demos/run.sh tables"


@pytest.mark.parametrize("run", ["terzaghi --rtol 1e-3", "self_weight_column"])
def test_what_a_demo_has_printed_it_prints_again(run, tmp_path):
    demo, _, options = run.partition(" ")
    done = test_demos.run(demo, f"{options} --json --out {tmp_path}")
    again, kept = json.loads(done.stdout.splitlines()[-1]), json.loads(tables.kept(run).read_text())
    assert again["errors"] == pytest.approx(kept["errors"], rel=0.02, abs=1e-6)
