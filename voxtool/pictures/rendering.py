"""Pictures of an octree, a distance field or a tetrahedral volume.

Each wing has a scene: a frozen dataclass of its content and the options of its picture. All have
the same members: `kind` and `samples` (along a pixel's side, by default); `stages`, `left_out`,
`counts` and `device_bytes` for the plan; `points`, whose convex hull holds everything shown;
`local_rays`, rays in the frame in which they are drawn, or an error; `draw`, one value a ray; and
`why_empty`, the reason if no view shows anything.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np

from voxtool.adf.field.field import DistanceField
from voxtool.adf.pictures.scene import FieldScene
from voxtool.camera import FOV, MAX_SIDE, Camera, Rays
from voxtool.errors import MemoryLimitError, VoxtoolError, count_of
from voxtool.job import Cost, Job, Plan, one_call
from voxtool.memory import check_memory
from voxtool.opencl import Device, default_device
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree.octree import Octree
from voxtool.svo.pictures.raycast import OctreeScene
from voxtool.tets.pictures.scene import VolumeScene
from voxtool.tets.volume.volume import TetVolume

Content = Octree | MergedOctree | DistanceField | TetVolume
Scene = OctreeScene | FieldScene | VolumeScene

SIZE = (512, 512)  # pixels
RAY_BYTES = 16  # bytes of a ray's colour and opacity, float32
SMALLER = "choose a smaller --size or fewer --samples"
VISIBLE = 0.5 / 255  # opacity from which on 8 bits show something
SCENES: dict[type, Any] = {
    Octree: OctreeScene,
    MergedOctree: OctreeScene,
    DistanceField: FieldScene,
    TetVolume: VolumeScene,
}


def scene_of(content: Content, **options: Any) -> Scene:
    """Return the scene of content, or raise VoxtoolError if it has no such option or value."""
    if type(content) not in SCENES:
        raise VoxtoolError(
            f"a {type(content).__name__} cannot be drawn: give an Octree, a DistanceField or a "
            "TetVolume"
        )
    scene: Any = SCENES[type(content)]
    known = [f.name for f in fields(scene)][1:]
    for name in options.keys() - known:
        raise VoxtoolError(f"{name} is no option of the {scene.kind}: choose {', '.join(known)}")
    return scene(content, **options)


@dataclass(frozen=True)
class RenderPlan(Plan):
    """The plan of a picture: the scene, width and height in pixels, and samples along a pixel's
    side."""

    facts = ("kind: scene.kind", "size", "samples", "rays")

    scene: Scene
    size: tuple[int, int]
    samples: int

    @property
    def stages(self) -> tuple[str, ...]:
        return self.scene.stages

    @property
    def reasons(self) -> dict[str, str]:
        return self.scene.left_out

    @property
    def rays(self) -> int:
        """The number of rays."""
        return self.size[0] * self.size[1] * self.samples**2

    @property
    def cost(self) -> Cost:
        """On the device the scene and the rays' colours; on the host those as they are read back,
        and the pixels in float64 and as integers."""
        rays = RAY_BYTES * self.rays
        pixels = RAY_BYTES * self.size[0] * self.size[1]
        return Cost(self.scene.device_bytes + rays, host=rays + 6 * pixels, largest=rays)

    def decisions(self) -> dict[str, Any]:
        return {**super().decisions(), **self.scene.counts}

    def rows(self) -> list[tuple[str, str]]:
        each = f" of {self.samples} x {self.samples} rays" if self.samples > 1 else ""
        counts = self.scene.counts.items()
        return [
            ("picture", f"{self.size[0]} x {self.size[1]} pixels{each}"),
            (self.scene.kind, ", ".join(f"{n:,} {name.replace('_', ' ')}" for name, n in counts)),
            ("rays", f"{self.rays:,}"),
        ]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        if not (shortage := self.cost.shortage(max_memory, max_allocation)):
            return
        alone = self.scene.device_bytes > max_memory
        hint = f"the {self.scene.kind} alone is too large" if alone else SMALLER
        raise MemoryLimitError(
            f"a picture of {self.size[0]} x {self.size[1]} pixels, "
            f"{count_of(self.samples**2, 'ray')} each, {shortage}: {hint} (see --max-memory)"
        )


@dataclass(eq=False)
class RenderJob(Job[np.ndarray]):
    """A planned picture, and the rays of all samples; `run` returns (H, W, 4) float32,
    premultiplied."""

    plan: RenderPlan
    rays: Rays
    device: Device
    max_memory: int | None

    def with_(self, **decisions: Any) -> Self:
        """Return the same job with options or decisions of its scene forced."""
        return super().with_(scene=replace(self.plan.scene, **decisions))  # pyright: ignore

    def refuse(self) -> None:
        super().refuse()
        check_memory(self.cost.host, f"{self.plan.rays:,} rays", SMALLER)

    def _run(self) -> np.ndarray:
        return averaged(self.plan.scene.draw(self.rays, self.device), self.plan.samples)

    def findings(self, result: np.ndarray) -> Iterator[str]:
        """Yield why nothing is visible, if nothing is."""
        most, scene = float(result[..., 3].max()), self.plan.scene
        if most >= VISIBLE:
            return
        points = scene.points()
        corners = points.min(axis=0), points.max(axis=0)
        box = " to ".join(f"({', '.join(f'{v:.6g}' for v in corner)})" for corner in corners)
        why = scene.why_empty()
        if not why and most > 0:
            why = f"its opacity is at most {most:.1g}: choose a smaller unit distance"
        elif not why and not self.rays.meet_box(points):
            why = f"the camera looks past the content in {box}: the iso view shows all of it"
        miss = f"no ray hits the content in {box}: move the camera closer, or choose more samples"
        yield f"the picture is empty: {why or miss}"


def plan_render(
    content: Content,
    view: Camera | Rays | str | None = None,
    *,
    size: tuple[int, int] = SIZE,
    samples: int | None = None,
    device: Device | None = None,
    max_memory: int | None = None,
    **options: Any,
) -> RenderJob:
    """Return the job of a picture of content; see voxtool.render."""
    scene = scene_of(content, **options)
    if isinstance(view, Rays):
        samples = samples or 1
        rays = view.finer(samples)
        size = view.size
    else:
        samples = samples or (scene.samples if scene.samples * max(size) <= MAX_SIDE else 1)
        camera = view if isinstance(view, Camera) else camera_for(scene, view or "iso", size=size)
        rays = camera.rays(samples * size[0], samples * size[1])
    scene.local_rays(rays)  # refuses an eye too far away and a height too small or large
    device = device or default_device()
    device.require_float64("pictures")
    return RenderJob(RenderPlan(scene, size, samples), rays, device, max_memory)


render = one_call(plan_render, "render", np.ndarray)


def camera_for(
    content: Content | Scene,
    view: str = "iso",
    *,
    eye: Sequence[float] | None = None,
    target: Sequence[float] | None = None,
    up: Sequence[float] = (0.0, 1.0, 0.0),
    fov: float | None = FOV,
    height: float | None = None,
    turn: float | None = None,
    size: tuple[int, int] = SIZE,
    **options: Any,
) -> Camera:
    """Return a camera that looks at content.

    Parameters
    ----------
    content : Octree, DistanceField or TetVolume
        What the camera looks at.
    view : str
        Name of a view; everything is in the picture.
    eye, target : three floats, optional
        Position of the camera and the point that it looks at, world units. By default those of the
        view; the target is the middle of the content.
    up : three floats
        Any direction that is not parallel to the view.
    fov : float or None
        Angle of the picture's shorter side in degrees; None for an orthographic camera.
    height : float, optional
        Length of an orthographic picture's shorter side, world units. By default everything is in
        the picture.
    turn : float, optional
        Angle in degrees by which the camera turns about `up` around the target. The distance is
        the same at every angle, and everything is in the picture.
    size : (int, int)
        Width and height of the picture in pixels.
    **options
        Options of the scene, as in `render`.

    Returns
    -------
    Camera

    Raises
    ------
    VoxtoolError
        If the numbers do not describe a camera.
    """
    scene = scene_of(content, **options) if isinstance(content, Content) else content
    points, up = scene.points(), tuple(up)
    camera = Camera.fit(points.min(axis=0), points.max(axis=0), view, up=up, fov=fov)
    if eye is not None:
        target = camera.target if target is None else tuple(target)
        camera = Camera(tuple(eye), target, up, fov, camera.height)  # pyright: ignore
    elif turn is None:
        camera = camera.framed(points, *size)
    if height is not None:
        camera = replace(camera, height=height)
    return camera if turn is None else camera.turned(turn)


def averaged(picture: np.ndarray, samples: int) -> np.ndarray:
    """Return the means of samples x samples pixels of an (H, W, 4) picture, rounded to float32 once
    from float64."""
    if samples == 1:
        return picture
    total = np.zeros((picture.shape[0] // samples, picture.shape[1] // samples, 4))
    for row, column in itertools.product(range(samples), repeat=2):
        total += picture[row::samples, column::samples]
    return (total / samples**2).astype(np.float32)
