# SPDX-License-Identifier: MIT
"""Write the numbers in README.md and demos/README.md from the output of the demos.

A comment follows each number.  The comment contains the command of the demo, the entries of its JSON output, and a
format:

    | Terzaghi's column, pressure at T_v = 0.5 | 0.004 % <!-- terzaghi --cells 50; errors/p_0.5; % --> |

demos/results contains the output of the demos, with the run time in `seconds` and the release of dolfinx.
demos/pictures contains the pictures of each demo, from the run that the pages name first. A table that a demo writes to
a file is copied between comments such as `<!-- error_vs_runtime; comparison.md -->` and `<!-- end -->`.

`bash demos/run.sh tables` writes the numbers from demos/results.  With `--run terzaghi mandel`, it first runs these
demos; `--run all` takes hours.
"""

from __future__ import annotations

import argparse
import json
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

DEMOS = Path(__file__).parent
RESULTS = DEMOS / "results"
PAGES = (DEMOS.parent / "README.md", DEMOS / "README.md")
FIGURE = re.compile(r"(?<=\| )[^|\n]*?(?P<comment><!-- (?P<run>\w[^;>]*); (?P<entries>[^;>]*); (?P<form>\S+) -->)")
TABLE = re.compile(
    r"(?P<begin><!-- (?P<run>\w[^;>]*); (?P<file>\w+\.md) -->\n)(?P<rows>.*?)(?P<end><!-- end -->)", re.S
)


def kept(run: str) -> Path:
    """Return the path of the stored output of a run."""
    return RESULTS / (re.sub(r"\W+", "_", run) + ".json")


def figure(value: float, form: str) -> str:
    """Return a number as text; `form` is %, +%, min (a time), or a format of Python."""
    if form.endswith("%"):
        return f"{100 * value:{form[:-1]}.2g}"
    if form == "min":
        return f"{value:.0f} s" if value < 100 else f"{value / 60:.0f} min"
    return f"{value:{form}}"


def figures(run: str, entries: str, form: str) -> str:
    """Return the numbers that a comment requests, as text."""
    if not kept(run).exists():
        sys.exit(f"{kept(run)}: missing, is written by: bash demos/run.sh tables --run {run.split()[0]}")
    printed, values = json.loads(kept(run).read_text()), []
    for entry in entries.split(" and "):
        value = printed
        for key in entry.split("/"):
            value = value[int(key) if isinstance(value, list) else key]
        values += value if isinstance(value, list) else [value]
    return ", ".join(figure(value, form) for value in values) + (" %" if form.endswith("%") else "")


def written(page: str) -> str:
    """Return a page with numbers and tables updated from demos/results."""
    page = FIGURE.sub(lambda m: f"{figures(m['run'], m['entries'], m['form'])} {m['comment']}", page)
    return TABLE.sub(lambda m: m["begin"] + kept(m["run"]).with_suffix(".md").read_text() + m["end"], page)


def runs(pages: Iterable[str]) -> dict[str, str]:
    """Return the runs in the comments of pages, each with the name of the table that it writes, or ""."""
    found = {}
    for page in pages:
        found |= {m["run"]: "" for m in FIGURE.finditer(page) if m["run"] not in found}
        found |= {m["run"]: m["file"] for m in TABLE.finditer(page)}
    return found


def take(run: str, table: str, pictures: bool) -> None:
    """Run a demo, and store its output, its table and, if `pictures` is True, its pictures."""
    import dolfinx

    demo, *options = shlex.split(run)
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(DEMOS / f"{demo}.py"), *options, "--json", "--out", folder]
        if demo == "benchmark_beam":  # draws nothing
            command = command[:-2]
        start = time.perf_counter()
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
        if done.returncode:
            sys.exit(f"{run}: ended with the exit status {done.returncode}")
        printed = {"run": run, "dolfinx": dolfinx.__version__, "seconds": round(time.perf_counter() - start, 1)}
        printed |= json.loads(done.stdout.splitlines()[-1])
        RESULTS.mkdir(exist_ok=True)
        kept(run).write_text(json.dumps(printed, indent=1) + "\n")
        if table:
            kept(run).with_suffix(".md").write_text((Path(folder) / table).read_text())
        for picture in (DEMOS / "pictures").iterdir():  # pictures on the pages
            if pictures and (Path(folder) / picture.name).exists():
                shutil.copy(Path(folder) / picture.name, picture)


def main(argv: list[str] | None = None) -> None:
    """Run the demos that --run names, and update the pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", nargs="+", default=[], metavar="DEMO", help="first run these demos, or all")
    o = parser.parse_args(argv)
    told = runs(page.read_text() for page in PAGES)
    demos = {shlex.split(run)[0] for run in told}
    for name in o.run:
        if name not in demos | {"all"}:
            parser.error(f"--run {name}: must be all, or among {', '.join(sorted(demos))}")
    drawn = {
        demo: run for run in reversed(told) for demo in shlex.split(run)[:1]
    }  # the first run of a demo makes the pictures
    for run, table in told.items():
        if {"all", demo := shlex.split(run)[0]} & {*o.run}:
            print(run, flush=True)
            take(run, table, drawn[demo] == run)
    for page in PAGES:
        page.write_text(written(page.read_text()))
    print(f"written: {', '.join(str(page) for page in PAGES)}")


if __name__ == "__main__":
    main()
