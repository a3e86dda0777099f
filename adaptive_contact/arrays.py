"""Defines types of arrays, and imports numpy late for modules that rarely need it."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray

    Array = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Mask = NDArray[np.bool_]
else:
    Array = ArrayLike = Ints = Mask = Any

    class _Numpy:
        """Loads numpy with the first function that is used: programs that only listen lack it."""

        def __getattr__(self, name: str) -> Any:
            found = getattr(importlib.import_module("numpy"), name)
            setattr(self, name, found)
            return found

    np = _Numpy()

__all__ = ["Array", "ArrayLike", "Ints", "Mask", "np"]
