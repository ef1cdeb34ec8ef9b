# SPDX-License-Identifier: MIT
"""Run scripts of this folder one after the other on the same processes: these start once, and compile each form once.

Arguments: the folder of the results, and scripts, each with its options. A script gets `<folder>/<script>` as its file.
"""

import runpy
import sys

from mpm_dolfinx.solve import solver_choice as plan

THRESHOLDS = plan.THRESHOLDS

folder, *scripts = sys.argv[1:]
for script in scripts:
    name, *options = script.split()
    plan.THRESHOLDS = THRESHOLDS  # a script may have replaced them
    sys.argv = [name, f"{folder}/{script}", *options]
    runpy.run_path(name, run_name="__main__")
