# SPDX-License-Identifier: MIT
"""Histories of a run: quantities at each output time, in arrays which all results of the run share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


def _none(*shape: int) -> NDArray[np.float64]:
    """Return an empty read-only array."""
    out = np.zeros(shape)
    out.flags.writeable = False
    return out


class Row(NamedTuple):
    """Quantities at one output time.  Quantities that were not recorded have empty arrays."""

    t: float  # time, s
    displacement: NDArray[np.float64] = _none(0, 0)  # of the probes (m, d), m
    pressure: NDArray[np.float64] = _none(0)  # minimum and maximum pore pressure of the points (2,), Pa
    position: NDArray[np.float64] = _none(0, 0)  # of the probes (m, d), m
    probe_pressure: NDArray[np.float64] = _none(0)  # pore pressure at the probes (m,), Pa, see `probe_fields`
    probe_stress: NDArray[np.float64] = _none(0, 3, 3)  # effective stress at the probes, tension positive (m, 3, 3), Pa
    outcome: Mapping[str, Mapping[str, NDArray[np.float64]]] = {}  # reactions, outflows and the like, see `State`


COLUMNS = tuple(name for name in Row._fields if name != "outcome")
"""Names of the numerical quantities of a `Row`: all except `outcome`."""


class _Columns:
    """Storage of histories: an array for each quantity, and a list of the effects of conditions, such as reactions."""

    def __init__(self, arrays: dict[str, NDArray[np.float64]], outcomes: list[Any]):
        self.arrays, self.outcomes = arrays, outcomes

    @property
    def used(self) -> int:
        return len(self.outcomes)

    def reshaped(self, count: int, capacity: int, shapes: dict[str, tuple[int, ...]]) -> _Columns:
        """Return a copy of the first `count` rows in larger arrays.  The spare rows contain nan."""
        out = {}
        for name, shape in shapes.items():
            out[name] = np.full((capacity, *shape), np.nan)
            if count:
                rows = self.arrays[name][:count]
                out[name][tuple(map(slice, rows.shape))] = rows
        return _Columns(out, self.outcomes[:count])


class Rows(Sequence[Row]):
    """Immutable sequence of one `Row` for each output time of a run.

    The method `more` returns a new object that shares its arrays with this object.  `more` thus takes the same time for
    any number of rows.  If a quantity has different shapes in two rows, the smaller array is padded with nan.

    Attributes
    ----------
    run
        Object that identifies the run.  The result of `more` has the same `run`.
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
        """Return n rows from n outcomes and an array (n, ...) of each quantity.  Raise ValueError if lengths differ."""
        if columns.keys() != set(COLUMNS):
            raise ValueError(f"the columns are {', '.join(columns)}, must be {', '.join(COLUMNS)}")
        if {len(values) for values in columns.values()} != {len(outcomes)}:
            raise ValueError("columns and outcomes have different lengths, must have equal lengths")
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

    def __reduce__(self):  # without the spare capacity
        return Rows.of_columns, ({name: self.column(name) for name in COLUMNS}, self.outcomes)

    @property
    def outcomes(self) -> list[Mapping[str, Mapping[str, NDArray[np.float64]]]]:
        """For each output time: reactions, outflows and other effects of the conditions."""
        return self._columns.outcomes[: self._count]

    def column(self, name: str) -> NDArray[np.float64]:
        """Return the values (n, ...) of one quantity at all output times, as a read-only view."""
        if not len(self):
            return np.array([getattr(Row(0.0), name)])[:0]
        out = self._columns.arrays[name][: self._count]
        out.flags.writeable = False
        return out

    def more(self, row: Row) -> Rows:
        """Return new histories with one more row."""
        columns, n = self._columns, self._count
        values = {name: np.asarray(value, dtype=np.float64) for name, value in zip(COLUMNS, row, strict=False)}
        old = {name: rows.shape[1:] if n else values[name].shape for name, rows in columns.arrays.items()}
        shapes = {name: tuple(np.maximum(v.shape, old.get(name, v.shape))) for name, v in values.items()}
        if columns.used != n or shapes != old:  # another object has extended the arrays, or the row has larger arrays
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
