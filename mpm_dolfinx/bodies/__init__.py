# SPDX-License-Identifier: MIT
"""Bodies as they are seeded: boxes, meshes, polygons, their faces, and where they touch."""
