# SPDX-License-Identifier: MIT
"""Seeded bodies: boxes, meshes, polygons and fills, with their faces and the contact between them."""
