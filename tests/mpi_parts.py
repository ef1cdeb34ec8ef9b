# SPDX-License-Identifier: MIT
"""Run a soft wet beam next to a stiff body on any number of processes, and write the state of both."""

import sys

import numpy as np
from far_bodies import beside

simulation = beside("drains", 1e6, wet=True)
history = [simulation.step(0.5).history for _ in range(2)]
stress, points = simulation.effective_stress(), simulation.points
parts = simulation.grid.comm.gather((points.id, points.x, points.pressure, stress))
if parts:
    ids, u, p, s = (np.concatenate(a) for a in zip(*parts, strict=True))
    order, n = np.argsort(ids), len(simulation.bodies[0])
    rows = {"u": u[order], "p": p[order], "s": s[order]}
    both = {f"{name} {i}": part for name, v in rows.items() for i, part in enumerate((v[:n], v[n:]))}
    counts, first = [len(part[0]) for part in parts], [h[0] for h in history]
    np.savez(sys.argv[1], **both, first=first, x=rows["u"], balance=0.0, counts=counts)
