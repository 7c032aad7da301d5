"""Work larger than one memory: windows of an octree, in Morton order, and what joins them."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from voxtool.tiles.make import combine, morph, voxelize

__all__ = ["combine", "morph", "voxelize"]


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("voxtool.tiles.make"), name)
