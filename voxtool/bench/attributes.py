"""Octrees with labels, areas, normals and colours, beside the octree without attributes."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.choices import LABEL_STYLES, VOXEL_FACES
from voxtool.files.meshes.mesh import load_mesh
from voxtool.grid import FIXED_POINT_BITS, Grid
from voxtool.mesh.appearance import Appearance
from voxtool.svo.attribution.colours import plan_attributes
from voxtool.svo.attribution.labels import PartLabelsJob, plan_labels
from voxtool.svo.images.attribute_image import AttributeImage
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.octree.octree import Octree
from voxtool.svo.surface.extract import plan_extract
from voxtool.svo.surface.labelled import LabelledSurface, plan_labelled
from voxtool.svo.voxelization.voxelize import plan_voxelize

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.points import Point
    from voxtool.bench.timing import Bench
    from voxtool.job import Job
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device

WORK, MESHES = "mesh to octree with attributes", "octree with attributes to meshes"
DENSE_DIM = 128  # up to which labels are compared
UNIT = 1 << FIXED_POINT_BITS
PARITY: dict[str, Any] = {"fill": "parity"}
TOO_LARGE = {"wrong": f"labels are compared up to dim {DENSE_DIM}"}


def measure(bench: Bench) -> Iterator[Point]:
    """Yield the points of a model: its solid without and with labels of its shells, with colours of
    its vertices, and with those of voxels alone that its surface meets; its surface without
    attributes, with areas, with normals, with colours of its vertices, and with colours and
    normals; and the meshes of labels and of colours."""
    mesh = load_mesh(bench.model)
    painted = with_colours(mesh)
    for dim in bench.request.dims:
        grid = Grid.fit(mesh, dim)
        row = partial(bench.point, label=f"dim {dim}", asked={"dims": dim}, size_of="voxels")
        solid = partial(plan_voxelize, mesh, grid, "solid", **PARITY)
        labels = partial(plan_labels, mesh, grid, "solid", labels="shell", **PARITY)
        surface = partial(plan_voxelize, mesh, grid, "surface26")
        for method, plan in (
            ("solid", solid),
            ("solid, labels of shells", labels),
            ("solid, colours", partial(with_attributes, solid, painted, "colour")),
            ("solid, colours where its surface is", partial(on_surface, solid, painted)),
            ("surface26", surface),
            ("surface26, areas", partial(with_attributes, surface, mesh, "area")),
            ("surface26, normals", partial(with_attributes, surface, mesh, "normal")),
            ("surface26, colours", partial(with_attributes, surface, painted, "colour")),
            (
                "surface26, colours and normals",
                partial(with_attributes, surface, painted, "colour", "normal"),
            ),
        ):
            job = plan(device=bench.timed)
            octree = job.run()
            errors, absent = {}, {}
            if isinstance(job, PartLabelsJob):
                if dim <= DENSE_DIM:
                    errors["wrong"] = wrong_labels(job, octree) / grid.dim**3
                else:
                    absent = TOO_LARGE
            else:
                plain = (solid if "solid" in method else surface)(device=bench.timed).run()
                errors["wrong"] = float(octree.set_digest() != plain.set_digest())
            if "areas" in method:
                found = octree.attribute("area").values.sum(dtype=np.float64)
                errors["area"] = abs(found / area_of(mesh, grid) - 1)
            held = sum(attribute.nbytes for attribute in octree.attributes)
            yield row(
                work=WORK, method=method, errors=errors,
                run=lambda device, plan=plan: plan(device=device).run(),
                absent=absent, bytes=octree.nbytes + held, size=octree.count,
            )  # fmt: skip
            if method in ("solid, labels of shells", "surface26, colours"):
                yield from surfaces(
                    octree, bench.timed, partial(row, work=MESHES, size=octree.count)
                )


def surfaces(octree: Octree, timed: Device, row: Any) -> Iterator[Point]:
    """Yield the points of the surfaces of an octree with labels or colours, and of those
    without."""
    what = octree.attributes[0].name
    for style in LABEL_STYLES if what == "label" else (VOXEL_FACES,):  # others need an inside

        def plain(device: Device, style: str = style) -> Any:
            return plan_extract(octree, style=style, device=device).with_(colours=False)

        def ours(device: Device, style: str = style) -> Any:
            if what == "label":
                return plan_labelled(octree, style=style)
            return plan_extract(octree, style=style, device=device)

        name = "meshes of labels" if what == "label" else "surface with colours"
        for method, plan in ((name, ours), (f"surface without {what}s", plain)):
            made = plan(timed).run()
            yield row(
                method=f"{method}, {style}", errors=errors_of(made, octree),
                bytes=made.vertices.nbytes + made.faces.nbytes,
                run=lambda device, plan=plan: plan(device).run(),
            )  # fmt: skip


def errors_of(made: Any, octree: Octree) -> dict[str, float]:
    """Return the volume that the surface lacks of the voxels', and the number of open meshes if
    there are labels."""
    whole = octree.count * octree.grid.voxel_volume
    if not isinstance(made, LabelledSurface):
        a, b, c = np.moveaxis(made.vertices[made.faces], 1, 0)
        return {"volume": abs(float((a * np.cross(b, c)).sum()) / 6 / whole - 1)}
    found = made.facts(check=True)
    is_open = sum(not one["closed"] for one in found)
    volume = sum(one["volume"] for one in found)
    return {"wrong": is_open / octree.grid.dim**3, "volume": abs(volume / whole - 1)}


def with_colours(mesh: Mesh) -> Mesh:
    """Return the mesh with a colour at each vertex, by its place in the mesh's box."""
    low, high = mesh.bounds
    colours = np.ones((len(mesh.vertices), 4))
    colours[:, :3] = np.clip((mesh.vertices - low) / np.maximum(high - low, 1e-300), 0, 1)
    none = np.full(len(mesh.faces), -1, np.int32)
    return replace(mesh, appearance=Appearance((), none, colours=colours))


def with_attributes(plan: Any, mesh: Mesh, *names: str, device: Device) -> Job[Octree]:
    """Return the job of a surface and attributes of it."""
    return plan_attributes(plan(device=device), mesh, names, device=device)


def on_surface(plan: Any, mesh: Mesh, *, device: Device) -> Job[Octree]:
    """Return the job of a solid with colours of the voxels that its surface meets."""
    return with_attributes(plan, mesh, "colour", device=device).with_(exposed=False)


def area_of(mesh: Mesh, grid: Grid) -> float:
    """Return the area of a mesh on the lattice of 1/256 voxel."""
    corners = grid.to_fixed(mesh.vertices)[mesh.faces] / UNIT * grid.pitch
    a, b, c = np.moveaxis(corners, 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def wrong_labels(job: PartLabelsJob, octree: Octree) -> int:
    """Return the voxels whose label is not that of the first part that sets it, each voxelized
    alone."""
    expected = np.zeros(job.grid.shape, np.int64)
    for part in job.own.parts[::-1].tolist():
        alone = plan_voxelize(job.own.alone(part, job.mesh), job.grid, device=job.device, **PARITY)
        expected[alone.run().to_dense()] = part + 1
    return int(np.count_nonzero(label_numbers(octree) != expected))


def label_numbers(octree: Octree) -> np.ndarray:
    """Return the label of each voxel from 1 on, and 0 of unset ones, (nx, ny, nz)."""
    image = AttributeImage(VoxelImage.of(octree), "label")
    return np.concatenate(list(image.slabs())).astype(np.int64)
