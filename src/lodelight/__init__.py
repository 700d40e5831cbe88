"""Indoor visual SLAM and localization, anchored by the building itself."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lodelight.io.sources import open_source as open_source
    from lodelight.localizer import Localizer as Localizer
    from lodelight.localizer import LocalizerConfig as LocalizerConfig
    from lodelight.mapping.store import load_map as load_map
    from lodelight.slam import Slam as Slam
    from lodelight.slam import SlamConfig as SlamConfig

__version__ = "0.1.0"

# Imported at first use, so that `import lodelight` costs nothing.
_EXPORTS = {
    "Localizer": "lodelight.localizer",
    "LocalizerConfig": "lodelight.localizer",
    "Slam": "lodelight.slam",
    "SlamConfig": "lodelight.slam",
    "load_map": "lodelight.mapping.store",
    "open_source": "lodelight.io.sources",
}
__all__ = ["__version__", *_EXPORTS]


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module 'lodelight' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_EXPORTS[name]), name)


def __dir__() -> list[str]:
    return __all__
