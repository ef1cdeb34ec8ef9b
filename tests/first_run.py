# SPDX-License-Identifier: MIT
"""Start time of the README's first scene: `python -m tests.first_run` prints it.

The first run has an empty cache of compiled forms, and the second run has the cache of the first run. Other programs
affect wall times, but hardly processor times. Compiled Python files are kept, as by default.
"""

import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]


def spent(code: str, cache: str) -> tuple[float, float]:
    """Return the wall time and the processor time, s, of a program and of its compilers."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    paths = os.pathsep.join([str(ROOT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)])
    settings = {**kept, "PYTHONPATH": paths, "XDG_CACHE_HOME": cache, "OMP_NUM_THREADS": "1"}
    subprocess.run([sys.executable, "-c", code], env=settings, stdout=subprocess.DEVNULL, check=True)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    scene = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.S)[1]
    with tempfile.TemporaryDirectory() as cache:
        spent("import mpm_dolfinx", cache)  # compiles Python files
        print(f"load of the machine {os.getloadavg()[0]:.1f}")
        print(f"{'':12} {'wall (s)':>9} {'processor (s)':>14} {'libraries':>10}")
        for name, code in (("import", "import mpm_dolfinx"), ("first run", scene), ("second run", scene)):
            wall, processor = spent(code, cache)
            libraries = len(list(Path(cache).glob("fenics/*.so")))
            print(f"{name:12} {wall:9.1f} {processor:14.1f} {libraries:10d}")
