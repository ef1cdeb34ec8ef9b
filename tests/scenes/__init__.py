# SPDX-License-Identifier: MIT
"""Random scenes as plain data, built and run under transformations that must not change what they show.

`description.drawn(seed)` gives a `Scene`; `frames` has the transformations; `running.run` builds a scene in a frame,
runs it, and brings what it shows back into the frame of its description.
"""
