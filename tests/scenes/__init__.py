# SPDX-License-Identifier: MIT
"""Random scenes as plain data, built and run under transformations that must not change their results.

`description.drawn(seed)` gives a `Scene`; `frames` has the transformations. `running.run` builds a scene in a frame,
runs it, and transforms its results back into the frame of the description.
"""
