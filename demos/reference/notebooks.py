# SPDX-License-Identifier: MIT
"""Write the tutorial and three short examples as notebooks: `python demos/reference/notebooks.py FOLDER`."""

import sys
from pathlib import Path

import jupytext
from pages import ROOT, parts

SCRIPTS = ("tutorial", "short/consolidation", "short/footing", "short/own_law")


def notebook(path: Path):
    """Return a script as a notebook. The docstring, and comments that fill a line, become text."""
    text, code = parts(path)
    words = "\n".join(
        f"# {line}".rstrip() for line in [f"# {path.stem.replace('_', ' ').capitalize()}", "", *text.split("\n")]
    )
    return jupytext.reads(f"{words}\n\n{code}\n", fmt="py:light")


def write(out: Path) -> list[Path]:
    """Write all notebooks into a folder, and return their files."""
    out.mkdir(parents=True, exist_ok=True)
    files = [out / f"{Path(name).name}.ipynb" for name in SCRIPTS]
    for name, file in zip(SCRIPTS, files, strict=True):
        jupytext.write(notebook(ROOT / "demos" / f"{name}.py"), file)
    return files


if __name__ == "__main__":
    print(*write(Path(sys.argv[1])), sep="\n")
