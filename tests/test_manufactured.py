# SPDX-License-Identifier: MIT
"""Second order in space and time at large strain, for a manufactured solution in a body that moves through the grid."""

import manufactured as made
import numpy as np


def after(cells, steps, t):
    """Return the errors of displacement and pressure after equal steps to time t."""
    s = made.scene(cells)
    for _ in range(steps):
        assert s.step(t / steps).balance < 1e-8
    return made.errors(s)


def of_elements(cells, steps, t):
    """Return the same errors of finite elements, with the same body force and source."""
    fem = made.reference(cells)
    for _ in range(steps):
        fem.step(t / steps)
    return made.errors(fem)


def rates(errors):
    """Return the orders of convergence between errors, if each size is half of the size before."""
    return np.log2(errors[:-1] / errors[1:])


def test_displacement_and_pressure_of_the_points_are_of_second_order_in_the_cell_size():
    """Twice as many steps as cells, while the top moves through four of 24 cells."""
    errors = np.array([after(cells, 2 * cells, 12.0) for cells in (6, 12, 24)])
    assert rates(errors).min() > 1.9 and (errors[-1] < [1e-4, 5e-4]).all(), errors


def test_displacement_and_pressure_of_the_points_are_of_second_order_in_the_step():
    """Steps so long that the error in space is small: the top moves by up to five cells in a step."""
    errors = np.array([after(32, steps, 20.0) for steps in (2, 4, 8)])
    assert rates(errors).min() > 1.9 and (errors[-1] < [5e-4, 8e-3]).all(), errors


def test_the_reference_is_of_second_order_in_the_cell_size_and_in_the_step():
    """4 to 16 elements per metre in twice as many steps; 16 elements in 2, 4 and 8 steps."""
    errors = np.array([of_elements(cells, 2 * cells, 12.0) for cells in (4, 8, 16)])
    assert rates(errors).min() > 1.9 and (errors[-1] < [1e-4, 1e-3]).all(), errors
    errors = np.array([of_elements(16, steps, 20.0) for steps in (2, 4, 8)])
    assert rates(errors).min() > 1.9 and (errors[-1] < [5e-4, 8e-3]).all(), errors
