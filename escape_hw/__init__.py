"""ESCAPE: calibrates adaptive-optics systems without a calibration source.

The names below are the public namespace for scripts::

    import escape_hw

    with escape_hw.open_system("razor-shwfs") as bench:
        bench.dm.send(bench.dm.shape)

They are loaded when first used, so that importing the package stays cheap.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from escape_hw.api.procedure import run
    from escape_hw.runtime.system import open_system

__version__ = "0.1.0"

#: Public name -> module that defines it. Add a line here, to ``__all__`` and to the block for type
#: checkers above to publish a name.
_HOME = {
    "open_system": "escape_hw.runtime.system",
    "run": "escape_hw.api.procedure",
}

__all__ = ["__version__", "open_system", "run"]


def __getattr__(name: str) -> Any:
    home = _HOME.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(home), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
