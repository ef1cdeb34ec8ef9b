# SPDX-License-Identifier: MIT
"""Rows of histories in arrays that grow with a run, and are shared by all results of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


def _none(*shape: int) -> NDArray[np.float64]:
    """Return an array of no numbers, that nobody changes."""
    out = np.zeros(shape)
    out.flags.writeable = False
    return out


class Row(NamedTuple):
    """Quantities at an output time; empty arrays where nothing is asked for, or there is no fluid.

    t, s; displacement (m, d), m, and present position (m, d), m, of the m probes; pressure (2,): least and largest on
    the points, Pa; probe_pressure (m,), Pa, and probe_stress (m, 3, 3), Pa: pore pressure and effective stress, tension
    positive, at the places of the probes, see `probe_fields`; outcome: what conditions do to the bodies, see `State`.
    """

    t: float
    displacement: NDArray[np.float64] = _none(0, 0)
    pressure: NDArray[np.float64] = _none(0)
    position: NDArray[np.float64] = _none(0, 0)
    probe_pressure: NDArray[np.float64] = _none(0)
    probe_stress: NDArray[np.float64] = _none(0, 3, 3)
    outcome: Mapping[str, Mapping[str, NDArray[np.float64]]] = {}


COLUMNS = tuple(name for name in Row._fields if name != "outcome")
"""Names of the quantities that are arrays."""


class _Columns:
    """Arrays (room, ...) by name, and the outcomes, of which the first `used` rows are written."""

    def __init__(self, arrays: dict[str, NDArray[np.float64]], outcomes: list[Any]):
        self.arrays, self.outcomes = arrays, outcomes

    @property
    def used(self) -> int:
        return len(self.outcomes)

    def reshaped(self, count: int, room: int, shapes: dict[str, tuple[int, ...]]) -> _Columns:
        """Return the first rows in arrays with room for more, of these shapes a row; nan where they have none."""
        out = {}
        for name, shape in shapes.items():
            out[name] = np.full((room, *shape), np.nan)
            if count:
                rows = self.arrays[name][:count]
                out[name][tuple(map(slice, rows.shape))] = rows
        return _Columns(out, self.outcomes[:count])


class Rows(Sequence[Row]):
    """Rows of the histories of a run, which nobody changes.

    Those with one more row share the arrays of those before: it takes the time of a row, however many there are.  Where
    rows differ in length, as from stage to stage, they are filled up with nan.

    Attributes
    ----------
    run
        The same for all histories that go on from the same first row.
    """

    def __init__(self, rows: Iterable[Row] = ()):
        self._columns = _Columns({}, [])
        self._count = 0
        self.run = object()
        for row in rows:
            grown = self.more(row)
            self._columns, self._count = grown._columns, grown._count

    @classmethod
    def of_columns(cls, columns: dict[str, NDArray[np.float64]], outcomes: Sequence[Any]) -> Rows:
        """Return rows from all columns (n, ...) by name, and the outcomes (n).

        ValueError where the columns are others, or differ in length.
        """
        if columns.keys() != set(COLUMNS):
            raise ValueError(f"columns {', '.join(columns)}, must be {', '.join(COLUMNS)}")
        if {len(values) for values in columns.values()} != {len(outcomes)}:
            raise ValueError("columns differ in length")
        out = cls()
        arrays = {name: np.array(columns[name], dtype=np.float64) for name in COLUMNS}
        out._columns, out._count = _Columns(arrays, list(outcomes)), len(outcomes)
        return out

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, k: int | slice) -> Row | Rows:
        if isinstance(k, slice):
            return Rows(self[i] for i in range(*k.indices(len(self))))
        t, *others = (self.column(name)[k] for name in COLUMNS)
        return Row(float(t), *others, self.outcomes[k])

    def __reduce__(self):  # without the room for more
        return Rows.of_columns, ({name: self.column(name) for name in COLUMNS}, self.outcomes)

    @property
    def outcomes(self) -> list[Mapping[str, Mapping[str, NDArray[np.float64]]]]:
        """What conditions did to the bodies, a copy of the list."""
        return self._columns.outcomes[: self._count]

    def column(self, name: str) -> NDArray[np.float64]:
        """Return one quantity (n, ...), which cannot be written into; it is not copied."""
        if not len(self):
            return np.array([getattr(Row(0.0), name)])[:0]
        out = self._columns.arrays[name][: self._count]
        out.flags.writeable = False
        return out

    def more(self, row: Row) -> Rows:
        """Return these rows and another one."""
        columns, n = self._columns, self._count
        values = {name: np.asarray(value, dtype=np.float64) for name, value in zip(COLUMNS, row, strict=False)}
        old = {name: rows.shape[1:] if n else values[name].shape for name, rows in columns.arrays.items()}
        shapes = {name: tuple(np.maximum(v.shape, old.get(name, v.shape))) for name, v in values.items()}
        if columns.used != n or shapes != old:  # others have gone on in them, or there is more to be held in a row
            columns = columns.reshaped(n, max(8, 2 * n), shapes)
        elif n == len(columns.arrays["t"]):
            columns.arrays = columns.reshaped(n, 2 * n, shapes).arrays
        for name, value in values.items():
            columns.arrays[name][(n, *map(slice, value.shape))] = value
        columns.outcomes.append(row.outcome)
        out = Rows()
        out._columns = columns
        out._count = n + 1
        out.run = self.run
        return out
