"""Exports and imports of the octree and the field of a mesh by every format: the time to write and
to read a file, its size beside that of voxtool's own, and the values that come back otherwise."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from voxtool.adf.construction.build import build_adf
from voxtool.adf.queries.samples import FieldSamples, grid_over
from voxtool.bench.timing import by_turns
from voxtool.bench.view import bytes_of_file
from voxtool.choices import LATTICES
from voxtool.errors import VoxtoolError, VoxtoolWarning
from voxtool.files import read_svo, write_svo
from voxtool.files.exchange import plan_export
from voxtool.files.formats import EXCHANGE, EXPORTS, IMAGES, ending, format_of
from voxtool.files.grids.voxels import array_of
from voxtool.files.imports import Source, read_voxels
from voxtool.files.meshes.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.sets.compare import count_differences
from voxtool.svo.solvers.wall_links import WallLinks, plan_wall_links
from voxtool.svo.voxelization.voxelize import voxelize

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from voxtool.bench.points import Point
    from voxtool.bench.timing import Bench
    from voxtool.mesh.mesh import Mesh
    from voxtool.svo.octree.octree import Octree

FORMATS = tuple(name for name in EXPORTS if EXCHANGE[name].parts)  # the others hold one slice
FIELD_FORMATS = tuple(name for name in EXPORTS if EXCHANGE[name].dense or EXCHANGE[name].levels)
OWN: dict[str, Callable[[Octree], Octree | MergedOctree]] = {  # voxtool's own
    "svo.h5": lambda octree: octree,
    "merged.svo.h5": MergedOctree.of,
}
MOST_BYTES = 256_000_000  # bytes of a file that is measured: a list of points may be very long
MOST_OF_HEXAHEDRA = 1_200_000_000  # of a file for solvers: ten million hexahedra
TOLERANCE = 1e-2  # sides, of the field: its files are measured, not its making
WITHOUT = {"returned": "voxtool does not read it"}


class Content(NamedTuple):
    """An octree or a field: what goes into files, and how it comes back."""

    name: str
    write: Callable[[Path], int]
    read: Callable[[Path], Any]
    differing: Callable[[Any], int]  # of what was read: the values that are others
    count: int  # of its values
    what: str  # they are
    own: int  # bytes of voxtool's own file


def measure(bench: Bench) -> Iterator[Point]:
    """Yield the points of a model."""
    mesh = load_mesh(bench.model)
    field = build_adf(mesh, bench.timed, tolerance=TOLERANCE, measure=False)
    own = bytes_of_file(field)
    for dim in bench.request.dims:
        voxels = voxelize(mesh, Grid.fit(mesh, dim), device=bench.timed)
        for name, stored in OWN.items():
            yield from _both_ways(own_content(voxels, stored), name, True, dim, bench)
        octree = octree_content(voxels)
        for name in FORMATS:
            yield from _both_ways(octree, name, EXCHANGE[name].reads, dim, bench)
        for lattice in LATTICES:
            yield _links(voxels, mesh, lattice, dim, bench)
        samples = field_content(FieldSamples(field, grid_over(field, dim), bench.timed), own)
        for name in FIELD_FORMATS:
            yield from _both_ways(samples, name, name in IMAGES, dim, bench)


def own_content(octree: Octree, stored: Callable[[Octree], Octree | MergedOctree]) -> Content:
    """Return an octree for voxtool's own files, which hold what `stored` makes of it."""

    def write(path: Path) -> int:
        write_svo(stored(octree), path)
        return path.stat().st_size

    return octree_content(octree)._replace(write=write, read=read_svo)


def octree_content(octree: Octree) -> Content:
    """Return an octree, whose values are its voxels."""
    grid = octree.grid

    def write(path: Path) -> int:
        hexahedra = EXCHANGE[format_of(path, EXPORTS)].hexahedra
        most = MOST_OF_HEXAHEDRA if hexahedra else MOST_BYTES
        return plan_export(octree, path, max_bytes=most).run()

    return Content(
        "octree",
        write,
        # .npy and .binvox do not say where the voxels lie
        lambda path: read_voxels(path, origin=grid.origin, pitch=grid.pitch),
        lambda found: sum(count_differences(octree, found)),
        octree.count, "voxels", bytes_of_file(octree),
    )  # fmt: skip


def field_content(samples: FieldSamples, own: int) -> Content:
    """Return a field, whose values are samples on a grid; it comes back as an array."""
    source, device = samples.source, samples.device

    def write(path: Path) -> int:
        levels = EXCHANGE[format_of(path, EXPORTS)].levels
        place: dict[str, Any] = {"spacing": samples.pitch[0]} if levels else {"grid": samples.grid}
        return plan_export(source, path, max_bytes=MOST_BYTES, device=device, **place).run()

    def read(path: Path) -> np.ndarray:
        with Source.of(path).stored() as stored:
            return array_of(stored, None, lambda share: None)

    expected = np.concatenate(list(samples.slabs()))
    return Content(
        "field", write, read, lambda found: int(np.count_nonzero(found != expected)),
        samples.cells, "samples", own,
    )  # fmt: skip


def _links(octree: Octree, mesh: Mesh, lattice: str, dim: int, bench: Bench) -> Point:
    """Return the point of the links of a lattice that cross the wall; its error counts those that
    no triangle crosses."""

    def work() -> WallLinks:
        return plan_wall_links(octree, mesh, lattice, device=bench.timed).run()

    links = work()  # the warm-up
    return bench.point(
        "octree to links", lattice, f"dim {dim}", runs=by_turns(bench.request, work)[0],
        asked={"dims": dim}, size=links.count, size_of="links",
        errors={"uncrossed": links.uncrossed / max(links.count, 1)},
    )  # fmt: skip


def _both_ways(content: Content, name: str, reads: bool, dim: int, bench: Bench) -> Iterator[Point]:
    """Yield the points of a format: writing a file, and reading it where that is possible; none,
    and a warning, where it cannot be written."""
    import tempfile  # slow to import, and the help of bench imports this module

    with tempfile.TemporaryDirectory(prefix="voxtool-bench-") as folder:
        path = Path(folder, "layers" if "%" in name else "", f"a{ending(name)}")
        works: dict[str, Callable[[], Any]] = {
            f"{content.name} to file": lambda: content.write(path)
        }
        try:
            size = content.write(path)  # the warm-up
        except VoxtoolError as error:
            what = f"{ending(name)} at dim {dim} is left out: {error}"
            warnings.warn(what, VoxtoolWarning, stacklevel=2)
            return
        fields: dict[str, Any] = {"absent": WITHOUT}
        if reads:
            works[f"file to {content.name}"] = lambda: content.read(path)
            differing = content.differing(content.read(path))
            fields = {"errors": {"returned": differing / max(content.count, 1)}}
        runs = by_turns(bench.request, *works.values())
        for work, seconds in zip(works, runs, strict=True):
            yield bench.point(
                work, ending(name), f"dim {dim}", runs=seconds, asked={"dims": dim},
                size=content.count, size_of=content.what, bytes=size,
                figures={"over the file": size / content.own}, **fields,
            )  # fmt: skip
