# SPDX-License-Identifier: MIT
"""The tests import scenes of the demos."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "demos"))


@pytest.fixture
def warned(recwarn):
    """Return a function that returns the messages of the package's warnings since its last call."""
    import mpm_dolfinx as mpm  # not above: xdist would hand its workers MPI's variables, with which mpirun ends

    def messages():
        found = [str(one.message) for one in recwarn if issubclass(one.category, mpm.ResultWarning)]
        recwarn.clear()
        return found

    return messages
