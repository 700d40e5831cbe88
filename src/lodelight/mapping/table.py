"""Growing columns: parallel numpy arrays with stable row numbers, for kernels and for blobs in the map file."""

from __future__ import annotations

from typing import Any

import numpy as np

from lodelight.types import AnyArray, Bools


class Table:
    """Rows appended in blocks; `table.xyz` is a live view of the column's rows.

    A view taken before an append keeps its rows but may no longer be the table's memory: take it anew after one.
    """

    def __init__(self, **columns: tuple[Any, tuple[int, ...]]) -> None:
        self._columns: dict[str, AnyArray] = {
            name: np.zeros((64, *shape), dtype) for name, (dtype, shape) in columns.items()
        }
        self._n = 0

    def __len__(self) -> int:
        return self._n

    def __getattr__(self, name: str) -> AnyArray:
        try:
            return self.__dict__["_columns"][name][: self._n]  # type: ignore[no-any-return]
        except KeyError:
            raise AttributeError(f"table has no column {name!r}") from None

    @property
    def columns(self) -> dict[str, AnyArray]:
        """Live views of all columns by name."""
        return {name: column[: self._n] for name, column in self._columns.items()}

    def append(self, count: int, **values: AnyArray | float | bool) -> int:
        """Append `count` rows (columns not named are zero) and return the number of the first."""
        start, end = self._n, self._n + count
        for name, column in self._columns.items():
            if end > len(column):
                grown = np.zeros((max(end, len(column) + len(column) // 2), *column.shape[1:]), column.dtype)
                grown[:start] = column[:start]
                self._columns[name] = column = grown
            column[start:end] = values.pop(name, 0)
        if values:
            raise AttributeError(f"table has no column {', '.join(values)}")
        self._n = end
        return start

    def keep(self, rows: Bools) -> None:
        """Only these rows (n,), in their order; the room of the others is given back."""
        for name, column in self._columns.items():
            self._columns[name] = column[: self._n][rows]
        self._n = int(np.count_nonzero(rows))
