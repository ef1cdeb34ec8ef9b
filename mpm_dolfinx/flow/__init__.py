# SPDX-License-Identifier: MIT
"""Balance of fluid: storage, and fluxes between cells."""
