# SPDX-License-Identifier: MIT
"""Copy the pages of the reference into a folder: `python demos/reference/pages.py FOLDER`.

The tutorial and the short examples become pages. Pages, and the files that pages link to, keep their relative paths.
"""

import re
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = ("README.md", "CHANGELOG.md", "demos/README.md", "mpm_dolfinx/README.md")
LINKED = ("demos/*.py", "demos/short/*.py", "demos/pictures/*", "demos/pictures/short/*", "CITATION.cff", "LICENSE")


def parts(path: Path) -> tuple[str, str]:
    """Return the docstring of a script and its code."""
    _, docstring, code = path.read_text().split('"""', 2)
    return docstring.strip(), code.strip()


def tutorial(path: Path) -> str:
    """Return the tutorial as a page; comments become text, and other lines become code."""
    text, code = parts(path)
    out = [f"# Tutorial\n\n{text}\n"]
    for block in re.findall(r"(?:^#.*\n?)+|(?:^(?!#).*\n?)+", code, re.M):
        if block.startswith("#"):
            words = re.sub(r"^# ?", "", block, flags=re.M)
            out.append(re.sub(r"\A(\d+\. .*?)\.?$", r"## \1", words, count=1, flags=re.M))
        elif block.strip():
            out.append(f"```python\n{block.strip()}\n```\n")
    return "\n".join(out)


def short(folder: Path) -> str:
    """Return the short examples as a page."""
    out = ["# Short examples\n"]
    for path in sorted(folder.glob("*.py")):
        text, code = parts(path)
        out.append(f"## {path.stem.replace('_', ' ').capitalize()}\n\n{text}\n\n```python\n{code}\n```\n")
        if (ROOT / "demos/pictures/short" / f"{path.stem}.png").exists():
            out.append(f"![{path.stem}](demos/pictures/short/{path.stem}.png)\n")
    return "\n".join(out)


def documented(folder: Path) -> dict[str, str]:
    """Return the public names of the reference, each with the stem of the file that documents it."""
    texts = {path.stem: path.read_text() for path in folder.glob("*.md")}
    return {name: stem for stem, text in texts.items() for name in re.findall(r"^::: mpm_dolfinx\.(\w+)$", text, re.M)}


def names(folder: Path) -> str:
    """Return a page with links to all public names, for reading without a server."""
    found = documented(folder)
    rows = [f"* [`{name}`]({found[name]}.md#mpm_dolfinx.{name})" for name in sorted(found, key=str.lower)]
    return "# All names\n\n" + "\n".join(rows) + "\n"


def lay(out: Path) -> None:
    """Empty a folder and copy all pages into it."""
    shutil.rmtree(out, ignore_errors=True)
    for pattern in (*PAGES, *LINKED):
        for path in ROOT.glob(pattern):
            if path.is_file():
                copy = out / path.relative_to(ROOT)
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, copy)
    shutil.copytree(Path(__file__).with_name("pages"), out / "reference")
    (out / "reference/names.md").write_text(names(Path(__file__).with_name("pages")))
    (out / "tutorial.md").write_text(tutorial(ROOT / "demos/tutorial.py"))
    (out / "short.md").write_text(short(ROOT / "demos/short"))


if __name__ == "__main__":
    lay(Path(sys.argv[1]))
