"""Pictures of the octree and of the field of a mesh, one ray a pixel, beside rays that other tools
cast at the mesh itself.

The error is the share of pixels in which a picture and the first peer disagree whether the model is
seen. It is no less than the error of voxels, or the tolerance, along the outline.
"""

from __future__ import annotations

import statistics
from dataclasses import replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from voxtool.bench import timing
from voxtool.distances import plan_field
from voxtool.files.meshes.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.pictures.rendering import camera_for, plan_render
from voxtool.svo.voxelization.voxelize import voxelize

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.points import Point
    from voxtool.bench.timing import Bench
    from voxtool.camera import Rays
    from voxtool.mesh.mesh import Mesh
    from voxtool.pictures.rendering import Content

WITHOUT = {"outline": "--peers casts rays at the mesh itself"}


def measure(bench: Bench) -> Iterator[Point]:
    """Yield the points of a model."""
    mesh = load_mesh(bench.model)
    contents = contents_of(mesh, bench)
    camera = camera_for(next(iter(contents.values()))[0], bench.request.view, fov=None)
    for size in bench.request.sizes:
        yield from _pictures(mesh, contents, camera.rays(size, size), bench)


def contents_of(mesh: Mesh, bench: Bench) -> dict[tuple[str, str], tuple[Content, dict]]:
    """Return the octrees and the fields of a mesh, and the settings of each, by method and
    label."""
    asked, device = bench.request, bench.timed
    contents: dict[tuple[str, str], tuple[Content, dict]] = {}
    for dim in asked.dims:
        octree = voxelize(mesh, Grid.fit(mesh, dim), device=device)
        contents["octree", f"dim {dim}"] = octree, {"dims": dim}
    for level, tolerance in product(asked.levels, asked.tolerances):
        request = {"tolerance": tolerance, "max_level": level, "fill": asked.fill}
        field = plan_field(mesh, device=device, **request).run()
        method = f"field, levels to {level}"
        settings = {"levels": level, "tolerances": tolerance}
        contents[method, f"tolerance {tolerance:g}"] = field, settings
    return contents


def _pictures(
    mesh: Mesh, contents: dict[tuple[str, str], tuple[Content, dict]], rays: Rays, bench: Bench
) -> Iterator[Point]:
    """Yield the peers at the rays of one size of picture, then a picture of each content."""
    asked, others = bench.request, timing.Peers(bench.request.repeat)
    size, seen, first = rays.size[0], None, 0.0
    row = partial(bench.point, f"picture of {size} x {size} rays", size=size, size_of="pixels")
    for peer, cast in (bench.tools.of_rays(mesh, rays) if asked.peers else {}).items():
        runs, found = others.times(peer, cast)
        if seen is None:
            seen, first = found, statistics.median(runs)
        yield row(
            f"{peer}, mesh", runs=runs, peer=True, asked={"sizes": size},
            errors={"outline": np.mean(found != seen)}, figures={"triangles": len(mesh.faces)},
        )  # fmt: skip
    for (method, label), (content, settings) in contents.items():
        plan = partial(plan_render, content, rays, samples=1)
        picture = plan(device=bench.timed).run()
        point = row(
            method, label, run=lambda device, plan=plan: plan(device=device).run(),
            asked={"sizes": size, **settings}, setting={"view": asked.view}, bytes=picture.nbytes,
            errors={} if seen is None else {"outline": np.mean((picture[..., 3] > 0) != seen)},
            absent=WITHOUT if seen is None else {},
        )  # fmt: skip
        ratio = {} if seen is None else {"times a peer": point.seconds / first}
        yield replace(point, figures={**point.figures, **ratio})
