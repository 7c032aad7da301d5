"""Pages of octrees, fields and volumes: the time to make them, their size beside the file's, and
the values that they unpack to wrongly, which no browser is needed to count."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from voxtool.adf.field.field import DistanceField
from voxtool.bench.pictures import contents_of
from voxtool.bench.request import is_volume
from voxtool.files import read_unstructured, write_adf, write_svo, write_tet
from voxtool.files.meshes.mesh import load_mesh
from voxtool.selftest.pages import wrong_values
from voxtool.svo.octree.octree import Octree
from voxtool.tets.construction.textures import build_tet
from voxtool.tets.volume.volume import TetVolume
from voxtool.viewer.job import plan_view

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from voxtool.bench.points import Point
    from voxtool.bench.timing import Bench
    from voxtool.pictures.rendering import Content

WRITERS: dict[type, tuple[str, Callable[[Any, Path], None]]] = {
    Octree: ("svo.h5", write_svo),
    DistanceField: ("adf.h5", write_adf),
    TetVolume: ("tet.h5", write_tet),
}


def measure(bench: Bench) -> Iterator[Point]:
    """Yield the points of a model."""
    asked = bench.request
    if is_volume(bench.model):
        mesh = read_unstructured(bench.model, asked.scalar, asked.component)
        volume = build_tet(mesh, "raycast", device=bench.timed)
        contents = {("volume", ""): (volume, {})}
    else:
        contents = contents_of(load_mesh(bench.model), bench)
    for (method, label), (content, settings) in contents.items():
        make = partial(plan_view, content, Path(bench.model).name)
        page = make().run()
        wrong, values = wrong_values(content, page)
        size, work = page.base_bytes + page.data_bytes, f"{page.content.kind} to page"
        yield bench.point(
            work, method, label, run=lambda device, make=make: make().run(),
            asked=settings, size=page.content.nbytes, size_of="bytes of data", bytes=size,
            errors={"unpacked": wrong / max(values, 1)},
            figures={"over the file": size / bytes_of_file(content), "base": page.base_bytes},
        )  # fmt: skip


def bytes_of_file(content: Content) -> int:
    """Return the bytes of the file with the content."""
    import tempfile  # slow to import, and the help of bench imports this module

    name, write = WRITERS[type(content)]
    with tempfile.TemporaryDirectory(prefix="voxtool-bench-") as folder:
        file = Path(folder, name)
        write(content, file)
        return file.stat().st_size
