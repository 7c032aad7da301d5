"""Levels of a field under construction that wait elsewhere than in memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from voxtool.adf.construction.stages import Level
from voxtool.opencl import Device


class Store(Protocol):
    """Arrays that wait elsewhere than in memory, as voxtool.files.storage.spool.Spool has them."""

    def put(self, array: np.ndarray) -> Any:
        """Add an array; return what `get` takes."""
        ...

    def get(self, piece: Any) -> np.ndarray:
        """Return an array."""
        ...

    def mapped(self, dtype: type, shape: tuple[int, ...]) -> np.ndarray:
        """Return all that was added as one array, which is read where it is used."""
        ...


@dataclass(frozen=True)
class Waiting:
    """A Level whose arrays are in a store."""

    number: int
    count: int
    store: Store
    pieces: dict[str, Any]

    @classmethod
    def of(cls, level: Level, store: Store) -> Waiting:
        """Put a new level, of which no stage has run, in a store."""
        pieces = {name: store.put(array.get()) for name, array in level.arrays.items()}
        return cls(level.number, level.count, store, pieces)

    def level(self, device: Device) -> Level:
        """Return the level on the device."""
        arrays = {name: device.put(self.store.get(piece)) for name, piece in self.pieces.items()}
        return Level(self.number, self.count, arrays)
