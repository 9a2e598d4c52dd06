"""Tables for pandas and polars: rows as they are, or in the wide form.

Neither library is imported before a table is made for it.
"""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from typing import Any


class ArrowTable(ABC):
    """A table that any library takes which speaks the Arrow PyCapsule interface."""

    @abstractmethod
    def __arrow_c_stream__(self, requested_schema: object = None) -> Any: ...

    def to_pandas(self) -> Any:
        """Return a pandas.DataFrame; its `time` is datetime64[ns, UTC], and what is missing is NaN.

        Raises ImportError where pandas or pyarrow is not installed.
        """
        _library("pandas", "pandas", "to_pandas")
        return _library("pyarrow", "pandas", "to_pandas").table(self).to_pandas()

    def to_polars(self) -> Any:
        """Return a polars.DataFrame; its `time` is Datetime("ns", "UTC"), and what is missing is null.

        Raises ImportError where polars is not installed.
        """
        return _library("polars", "polars", "to_polars").DataFrame(self)


def nanoarrow() -> Any:
    """Return the library that holds rows in Arrow's layout; ImportError where it is not installed."""
    try:
        return importlib.import_module("nanoarrow")
    except ImportError as failure:
        raise ImportError(
            "rows in Arrow's layout, such as those of a recording that is read, need nanoarrow, which is not "
            "installed: pip install nanoarrow",
            name="nanoarrow",
        ) from failure


def _library(name: str, extra: str, method: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as failure:
        raise ImportError(
            f"{method}() needs {name}, which is not installed: pip install 'multidrop[{extra}]'"
        ) from failure
