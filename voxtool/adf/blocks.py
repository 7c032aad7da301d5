"""The blocks of a field under construction, on the host, and the counts of their errors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.adf.bounds import NO_LEAF
from voxtool.adf.cells import cell_of, identifier_type, key_of
from voxtool.adf.field import DistanceField, assemble
from voxtool.adf.hashing import build_hash
from voxtool.adf.plan import BLOCK_BYTES
from voxtool.adf.survey import cube_of

if TYPE_CHECKING:
    from voxtool.adf.levels.examine import Examined
    from voxtool.adf.levels.level import Construction, Level


class Blocks:
    """The blocks of all levels so far."""

    def __init__(self) -> None:
        self.identifiers: list[np.ndarray] = []
        self.voxels: list[np.ndarray] = []
        self.codes: list[np.ndarray] = []
        self.missed = self.jumps = 0
        self.worst: tuple[float, int, int] | None = None  # error, level, identifier

    def add(self, level: Level, found: Examined, tolerance: float) -> None:
        """Add the blocks of a level."""
        self.identifiers.append(level.identifiers.get())
        self.voxels.append(found.voxels)
        codes = np.where(found.refined != 0, np.uint8(NO_LEAF), found.codes)
        self.codes.append(codes)
        self._count_missed(level, found.errors, tolerance)

    def limit(self, found: Examined, max_bytes: int) -> None:
        """Limit refinement to max_bytes: the children with the largest errors come first."""
        left = max_bytes // BLOCK_BYTES - sum(map(len, self.identifiers)) - len(found.voxels) // 27
        candidates = np.flatnonzero(found.refined)
        worst_first = np.argsort(-found.errors[candidates], kind="stable")
        found.refined[candidates[worst_first[max(left, 0) :]]] = 0

    def _count_missed(self, level: Level, errors: np.ndarray, tolerance: float) -> None:
        leaves = self.codes[-1] != NO_LEAF
        self.jumps += int(np.count_nonzero((errors < 0) & leaves))
        over = np.flatnonzero((errors > np.float32(tolerance)) & leaves)
        if len(over) == 0:
            return
        self.missed += len(over)
        worst = over[np.argmax(errors[over])]
        if self.worst is None or errors[worst] > self.worst[0]:
            identifier = int(self.identifiers[-1][worst // 8]) << 3 | int(worst % 8)
            self.worst = (float(errors[worst]), level.number + 1, identifier)

    def field(self, work: Construction) -> DistanceField:
        """Return the field that consists of the blocks."""
        plan, mesh = work.plan, work.survey.mesh
        origin, side = cube_of(mesh)
        identifiers = np.concatenate(self.identifiers)
        levels, ijk = cell_of(identifiers)
        with work.device.stage("hash"):
            table = build_hash(key_of(levels, ijk), work.device)
        reached = self._reached(origin, side)
        if plan.continuous:
            reached["balanced"] = not work.unbalanced.get()[0]
        return assemble(
            identifiers.astype(identifier_type(int(levels[-1]))),
            np.concatenate(self.voxels).reshape(-1, 3, 3, 3),
            np.concatenate(self.codes).reshape(-1, 2, 2, 2) if plan.bounds else None,
            table,
            origin=tuple(origin.tolist()),
            side=side,
            sign=plan.sign,
            tolerance=plan.tolerance,
            max_level=plan.max_level,
            band=plan.band,
            continuous=plan.continuous,
            lipschitz=float(work.steepest.get().view(np.float32)[0]),
            reached=reached,
            plan=plan.scene(),
            source_sha256=mesh.source_sha256,
            units=mesh.units,
        )

    def _reached(self, origin: np.ndarray, side: float) -> dict[str, Any]:
        reached: dict[str, Any] = {
            "leaves": 7 * sum(map(len, self.identifiers)) + 1,
            "missed": self.missed,
            "jumps": self.jumps,
        }
        if self.worst:
            error, level, identifier = self.worst
            cell = cell_of(np.array([identifier], np.uint64))[1][0]
            where = origin + side * np.ldexp(cell + 0.5, -level)
            reached["worst"] = {"error": error, "level": level, "where": where.tolist()}
        return reached
