# SPDX-License-Identifier: MIT
"""Seeded bodies: boxes, meshes, polygons, fills; their faces, and contact between seeded bodies."""
