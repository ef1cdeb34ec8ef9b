# SPDX-License-Identifier: MIT
"""The README's code runs as it stands, and names only what exists."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", README, flags=re.S)


@pytest.mark.parametrize("code", BLOCKS)
def test_code_blocks_run(code, capsys):
    if "mpm.polygon(" in code:
        pytest.importorskip("gmsh")
    exec(compile(code, "README.md", "exec"), {})
    assert capsys.readouterr().out


def test_named_files_exist():
    files = re.findall(r"\]\(([^)]+)\)", README) + re.findall(r"`(mpm_dolfinx/[\w.]+|tests/\w+\.\w+)`", README)
    assert len(files) > 3
    for file in files:
        assert (ROOT / file).exists(), file
    for module in re.findall(r"\(`(\w+\.py)`", README):
        assert (ROOT / "mpm_dolfinx" / module).exists(), module
    for demo in re.findall(r"demos/run\.sh (\w+)", README):
        assert (ROOT / "demos" / f"{demo}.py").exists(), demo
