"""Defines types of arrays, and imports numpy and scipy late for modules that rarely need them."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    import scipy
    from numpy.typing import ArrayLike, NDArray

    Array = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Mask = NDArray[np.bool_]
else:
    Array = ArrayLike = Ints = Mask = Any

    class _Late:
        """Loads a library with the first name that is used: programs that only listen lack some."""

        def __init__(self, library: str) -> None:
            self._library = library

        def __getattr__(self, name: str) -> Any:
            found = getattr(importlib.import_module(self._library), name)
            setattr(self, name, found)
            return found

    np, scipy = _Late("numpy"), _Late("scipy")

__all__ = ["Array", "ArrayLike", "Ints", "Mask", "np", "scipy"]
