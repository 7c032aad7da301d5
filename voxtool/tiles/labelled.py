"""Labels in windows: each window from the parts that reach it, by the rules of the whole parts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from voxtool.arrays import digest_of
from voxtool.errors import OnePieceError
from voxtool.files.octrees.windows import Key
from voxtool.svo.attribution.labels import PartLabelsJob, fill_of
from voxtool.svo.attribution.labels_window import PartsOfWindows
from voxtool.svo.octree.attributes import Attribute
from voxtool.tiles.octree import BlockOctree
from voxtool.tiles.spread import Sent
from voxtool.tiles.subtree import MARGIN
from voxtool.tiles.windows import WindowsJob
from voxtool.tiles.workers import plan_labels


class LabelWindowsJob(WindowsJob):
    """A voxelization with labels that runs window by window."""

    whole: PartLabelsJob
    planner = staticmethod(plan_labels)

    def _take_over(self) -> None:
        whole = self.whole
        self._parts = PartsOfWindows.of(whole)
        self._wound = self._parts.with_rule("winding")
        flooded = np.flatnonzero(self._parts.with_rule("flood"))
        if len(flooded):
            name = whole.plan.names[self._parts.own.of[flooded[0]]]
            raise OnePieceError(
                f"part {name} is filled by flood, which is not made in windows beside other parts: "
                "allow more (see --max-memory), choose another --fill, or voxelize it by itself"
            )
        self._free()

    def _free(self) -> None:
        for job in self.whole.jobs:
            del job.lattice

    @property
    def _request(self) -> dict[str, Any]:
        """The content and the rules of the octree that is made, in JSON types."""
        whole, own = self.whole, self._parts.own
        fills = [self._parts.rules[part][0] for part in own.parts.tolist()]
        content = digest_of(self.grid.exact, own.points, own.faces, own.of, whole.ranks)
        rules = {"mode": whole.plan.mode, "fills": sorted(set(fills))}
        return {"content": content, **rules, "names": digest_of({"names": whole.plan.names})}

    @property
    def _rule(self) -> tuple[str, str]:
        return self.whole.plan.mode, fill_of(job.plan.rule for job in self.whole.jobs)

    def _faces_of(self, key: Key, faces: np.ndarray) -> np.ndarray:
        """Return those of some faces that can change a window: of parts filled by their winding
        number all, as holes far away count."""
        near = self._faces_near(key, faces, MARGIN, rows=not self.whole.plan.surface)
        wound = faces[self._wound[faces]]
        return np.union1d(near, wound) if len(wound) else near

    @cached_property
    def _sent_parts(self) -> Sent:
        """All parts, with what windows need of them."""
        return Sent(self._parts.sent(self.all_faces) if self.executor.workers else self._parts)

    def _given(self, faces: np.ndarray) -> tuple[Any, ...]:
        """Return the parts of some faces, and their numbers there. Workers are sent all parts once
        if some are filled by their winding number, as windows take these wholly."""
        if self.executor.workers and not self._wound.any():
            return self._parts.sent(faces), np.arange(len(faces))
        return self._sent_parts, faces

    def _sets_nothing(self, job: PartLabelsJob) -> bool:
        return not job.jobs

    def _kinds(self) -> Sequence[Attribute]:
        none = np.empty(0, self.whole.plan.dtype)
        return (*super()._kinds(), Attribute("label", none, none, names=self.whole.plan.names))

    def findings(self, octree: BlockOctree) -> Iterator[str]:
        """Yield a warning if parts set no voxel."""
        found = np.zeros(len(self.whole.plan.names), bool)
        for key in self._used:
            found[self.store.attribute(key, "label")["labels"]] = True
        yield from self.whole.lost(found)
