# SPDX-License-Identifier: MIT
"""Measures of the package's code may only decrease: each measure has a ceiling, which is lowered with it."""

import house
import pytest
import ways

CEILINGS = {
    "ad hoc named numbers": 53,
    "rules among numbers in functions": 3,
    "imports a file, mean": 5.54,
    "files in a circle of imports": 0,
    "folders in a circle of imports": 0,
    "files of the largest folder": 14,
    "parameters of the longest list": 12,
    "assignments of three and more values": 16,
    "changes of hidden state": 0,
    "asserts and RuntimeErrors": 3,  # of users on other processes, and of two reference solutions
    "files that name a condition's class, most": 6,
    "lines of the package": 41000,
}

WAYS = {"rooms of a traction": 13, "rooms of an initial pressure": 15, "homes of the pressure": 4}

HALF = 'Sensitivity (scene "bank" of tests/plateaus.py): half this value changes the result by 1e-5,'


@pytest.fixture(scope="module")
def measures():
    return house.measures()


@pytest.mark.parametrize("name", CEILINGS)
def test_measure_is_not_above_its_ceiling(measures, name):
    assert measures[name] <= CEILINGS[name]


def test_values_pass_no_more_rooms_and_pressures_have_no_more_homes():
    found = ways.measures()
    assert set(found) == set(WAYS)
    for name, most in WAYS.items():
        assert 0 < len(found[name]) <= most, found[name]


def test_every_measure_has_a_ceiling(measures):
    assert set(measures) == set(CEILINGS)


@pytest.mark.parametrize(
    ("said", "holds"),
    [
        ("Half of a cell.", False),
        ("Source: it works well", False),
        ("Source: Higham (2002), eq. 3.4.", True),
        (f"{HALF} and twice this value by 2e-5. Finer cells change it by 3e-3.", True),
        (f"{HALF} and twice this value by 4e-3. Finer cells change it by 3e-3.", False),
    ],
)
def test_number_has_a_source_or_moves_less_than_the_cells(said, holds):
    assert house.sourced(said) is holds
