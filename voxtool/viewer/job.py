"""Planning a page: what it shows, how large it is, and whether a browser can hold it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from voxtool.adf.field.field import DistanceField
from voxtool.camera import Camera
from voxtool.errors import MemoryLimitError, VoxtoolError, human
from voxtool.job import Cost, Job, Plan
from voxtool.pictures.rendering import Content, camera_for, scene_of
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree.octree import Octree
from voxtool.tets.volume.volume import TetVolume
from voxtool.viewer.content import PageContent
from voxtool.viewer.fields import field_content
from voxtool.viewer.octrees import octree_content
from voxtool.viewer.page import Page, page_of
from voxtool.viewer.volumes import volume_content

# Bytes of data that a page holds: as base64 they stay below the longest text of browsers, 2**29.
MOST_DATA = 1 << 28
CONTENTS: dict[type, Callable[[Any], PageContent]] = {
    DistanceField: field_content,
    TetVolume: volume_content,
}


@dataclass(frozen=True)
class ViewPlan(Plan):
    """The plan of a page: what it shows, the name of the file, the camera at the start, and whether
    the data are served beside the page instead of in it."""

    stages = ("compress data",)
    facts = ("kind: content.kind",)
    costs = ("host",)

    content: PageContent
    name: str
    camera: Camera
    served: bool = False

    @property
    def reasons(self) -> dict[str, str]:
        return {
            "scripts and shaders of other kinds": f"the page shows one {self.content.kind}",
            "data in the page": "they are served beside it" if self.served else "",
        }

    @property
    def cost(self) -> Cost:
        """On the host the arrays, compressed, as base64, and in the page."""
        return Cost(0, host=5 * self.content.nbytes)

    def decisions(self) -> dict[str, Any]:
        content = self.content
        return {
            **super().decisions(),
            "arrays": {name: list(array.shape) for name, array in content.arrays.items()},
            "data_bytes": content.nbytes,
            "served": self.served,
        }

    def rows(self) -> list[tuple[str, str]]:
        arrays = self.content.arrays.items()
        shapes = ", ".join(f"{' x '.join(map(str, a.shape))} {name}" for name, a in arrays)
        return [
            ("page", f"{self.content.kind}, {human(self.content.nbytes)} of data"),
            ("arrays", shapes),
        ]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        if shortage := self.cost.shortage(max_memory, max_allocation):
            smaller = self.content.smaller_by(max_memory / self.cost.host)
            raise MemoryLimitError(f"the page {shortage}: {smaller} (see --max-memory)")
        if not self.served and self.content.nbytes > MOST_DATA:
            raise MemoryLimitError(
                f"{human(self.content.nbytes)} of data are more than a page holds, "
                f"{human(MOST_DATA)}: {self.content.smaller_by(MOST_DATA / self.content.nbytes)}, "
                "or serve them beside the page (voxtool view --serve)"
            )


@dataclass(eq=False)
class ViewJob(Job[Page]):
    """A planned page; `run` returns it."""

    plan: ViewPlan
    max_memory: int | None = None
    device: None = None

    def _run(self) -> Page:
        plan = self.plan
        with self.stage("compress data"):
            return page_of(plan.content, plan.name, {"camera": asdict(plan.camera)}, plan.served)


def plan_view(
    content: Content,
    name: str,
    *,
    up: Sequence[float] = (0.0, 1.0, 0.0),
    level: int | str = "voxel",
    isovalue: float | None = None,
    served: bool = False,
    max_memory: int | None = None,
) -> ViewJob:
    """Return the job of a page that shows content; see voxtool.view."""
    scene = scene_of(content)  # refuses what cannot be drawn
    camera = camera_for(scene, up=up)
    if isinstance(content, Octree | MergedOctree):
        made = octree_content(content, level, isovalue)
    elif level == "voxel" and isovalue is None:
        made = CONTENTS[type(content)](content)
    else:
        given = f"level {level!r}" if isovalue is None else f"isovalue {isovalue!r}"
        raise VoxtoolError(f"{given} is of octrees: this is a {scene.kind}")
    return ViewJob(ViewPlan(made, name, camera, served), max_memory)
