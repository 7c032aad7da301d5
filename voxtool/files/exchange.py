"""Export to the formats of other programs, by the table formats.EXCHANGE.

The module of a format has some of these functions:

    size(image) -> int                        bytes of the output, or a bound; a format of points
                                              takes size(image, normals=True), too
    write(image, file, **options)             write a VoxelImage, or FieldSamples to a dense format,
                                              into an empty file that can seek, or into an empty
                                              folder if the format is one
    read(file, size) -> Stored                see imports.py

In the module that writes level sets (Exchange.levels), `size` and `write` take a LevelSet; in the
one that writes volumes (Exchange.volumes), VolumeCells; in those of Exchange.hexahedra, Hexahedra.
A module of several formats has such functions for each of them, whose names end in the format's
suffix. It imports what its extra brings inside these functions.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from voxtool.adf.field.field import DistanceField
from voxtool.adf.queries.samples import FieldSamples, grid_over
from voxtool.adf.surface.narrow_band import LevelSet
from voxtool.errors import FileError, GridError, MemoryLimitError, VoxtoolError, human
from voxtool.files.cells.vtkhdf_volume import VolumeCells
from voxtool.files.formats import (
    EXCHANGE,
    EXPORTS,
    Exchange,
    check_output,
    check_package,
    folder_of,
    format_of,
    function_of,
)
from voxtool.files.grids.attributes import chosen_attributes
from voxtool.files.lattices import unit_checked
from voxtool.files.storage import atomic, streams
from voxtool.files.storage.streams import PathLike
from voxtool.grid import Grid, check_single
from voxtool.job import Cost, Job, Plan
from voxtool.memory import available_memory, check_disk
from voxtool.opencl import Device
from voxtool.svo.images.attribute_image import AttributeImage, attributes_of
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.images.image_parts import ImageInParts, bytes_of, fitting_image
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.sets.labels import Labels
from voxtool.svo.solvers.hexahedra import Hexahedra
from voxtool.svo.solvers.leaf_hexahedra import LeafHexahedra
from voxtool.tets.volume.volume import TetVolume

WRITE = "write file"
Image: TypeAlias = (
    VoxelImage | AttributeImage | LevelSet | FieldSamples | Labels | VolumeCells | Hexahedra
)
Content: TypeAlias = OctreeContent | DistanceField | TetVolume | Labels


def writer_of(name: str, verb: str, image: Image) -> Callable[..., Any]:
    """Return the function of a format, `size` or `write`, that takes an image."""
    if isinstance(image, LevelSet):
        return getattr(import_module(f"voxtool.files.{EXCHANGE[name].levels}"), verb)
    if isinstance(image, VolumeCells):
        return getattr(import_module(f"voxtool.files.{EXCHANGE[name].volumes}"), verb)
    return function_of(name, verb)


def place_of(
    image: VoxelImage | AttributeImage | LevelSet | FieldSamples | Labels,
) -> dict[str, Any]:
    """Return the level, the shape and the place of an image, in JSON types."""
    place = {name: list(getattr(image, name)) for name in ("shape", "origin", "pitch")}
    return {"level": image.level, **place}


@dataclass(frozen=True)
class ExportPlan(Plan):
    """The plan of an export: the image, the format and the bytes to come."""

    stages = (WRITE,)
    facts = ()
    costs = ("host",)
    refusal = "the export {shortage}: choose {plan.instead}"

    image: Image
    name: str
    size: int
    options: dict[str, Any]
    reasons: dict[str, str] = field(default_factory=dict)

    @property
    def format(self) -> Exchange:
        """The line of the table."""
        return EXCHANGE[self.name]

    @property
    def cost(self) -> Cost:
        """The memory of what is held of the image at once."""
        more = sum(attribute.own_bytes for attribute in self.attributes)
        return Cost(0, host=self.image.host_bytes + more)

    @property
    def attributes(self) -> list[AttributeImage]:
        """The attributes that are written beside the image."""
        return attributes_of(self.image)

    def decisions(self) -> dict[str, Any]:
        about = {"format": self.name, "keeps": self.format.keeps, **self.about, "bytes": self.size}
        return {**about, **super().decisions()}

    @property
    def about(self) -> dict[str, Any]:
        """The shape, place and types of the image, in JSON types."""
        image = self.image
        if isinstance(image, VolumeCells):
            return image.facts
        if isinstance(image, Hexahedra):
            return {**place_of(image.image), **image.facts}
        found = {**place_of(image), "dtype": image.dtype.name}
        if isinstance(image, AttributeImage):
            return {**found, "attributes": [image.name]}
        more = [attribute.name for attribute in self.attributes]
        return {**found, "attributes": more} if more else found

    @property
    def text(self) -> str:
        """The size of the image, for people."""
        image = self.image
        if isinstance(image, VolumeCells | Hexahedra):
            return image.text
        cells = "samples" if isinstance(image, LevelSet | FieldSamples) else "cells"
        cells += f" of level {image.level}" if image.level else ""
        cells += " in windows" if isinstance(image, ImageInParts) else ""
        names = self.about.get("attributes")
        cells += f" with {', '.join(names)}" if names else ""
        return f"{' x '.join(map(str, image.shape))} {cells}"

    def rows(self) -> list[tuple[str, str]]:
        image, about = self.image, self.text
        if isinstance(image, Hexahedra):
            about += f"; an edge is {' x '.join(f'{size:.6g}' for size in image.image.pitch)}"
        elif not isinstance(image, VolumeCells):
            sizes = " x ".join(f"{size:.6g}" for size in image.pitch)
            about += f", {image.dtype.name}; a cell is {sizes}"
        return [
            ("image", about),
            ("file", f".{self.name}, at most {human(self.size)}; it keeps {self.format.keeps}"),
        ]

    @property
    def instead(self) -> str:
        """What to choose if memory is short."""
        return f"{self.image.smaller}{', or --attribute none' * bool(self.about.get('attributes'))}"


@dataclass(eq=False)
class ExportJob(Job[int]):
    """A planned export; `run` writes it and returns the bytes that were written."""

    plan: ExportPlan
    path: PathLike
    clobber: bool = True
    max_bytes: int | None = None
    max_memory: int | None = None
    device: None = None

    def refuse(self) -> None:
        """Raise FileError or MemoryLimitError if --max-bytes, the disk or memory are too small."""
        size, instead = self.plan.size, f"choose {self.plan.image.smaller}"
        if isinstance(self.plan.image, VoxelImage):
            instead += ", or .npz"
        if self.max_bytes is not None and size > self.max_bytes:
            raise FileError(
                f"{self.path} would take up to {human(size)}, of {human(self.max_bytes)} allowed: "
                f"{instead}"
            )
        if self.path != streams.STREAM:
            check_disk(folder_of(self.path, self.plan.name), size, instead)
        super().refuse()

    def _run(self) -> int:
        plan, before = self.plan, atomic.written()
        write = writer_of(plan.name, "write", plan.image)
        with self.stage(WRITE):
            if plan.format.folder:
                with atomic.atomic_folder(folder_of(self.path, plan.name), self.clobber) as folder:
                    write(plan.image, folder, **plan.options)
            else:
                with streams.open_output(self.path, plan.format.text, self.clobber) as file:
                    write(plan.image, file, **plan.options)
        return atomic.written() - before


def plan_export(
    content: Content,
    path: PathLike,
    clobber: bool = True,
    format: str | None = None,
    *,
    level: int = 0,
    bbox: Sequence[float] | None = None,
    invert: bool = False,
    dtype: Any = None,
    isovalue: float | None = None,
    normals: bool = False,
    band: float | None = None,
    shape: Any = None,
    spacing: Any = None,
    grid: Grid | PathLike | None = None,
    lattice: Grid | PathLike | None = None,
    attributes: str | Sequence[str] | None = None,
    max_bytes: int | None = None,
    max_memory: int | None = None,
    windows: bool = True,
    leaves: bool = False,
    device: Device | None = None,
    progress: Callable[[float], None] = lambda share: None,
    **options: Any,
) -> ExportJob:
    """Return the job of an export; see voxtool.export."""
    name = format or format_of(path, EXPORTS)
    if name not in EXPORTS:
        raise FileError(f"format {name!r} is unknown: choose one of {', '.join(EXPORTS)}")
    if path == streams.STREAM and EXCHANGE[name].folder:
        raise FileError(f".{name} is a folder of files: name it, stdout takes one file")
    chosen = level or bbox or invert or dtype or isovalue is not None
    if chosen and not EXCHANGE[name].parts:
        raise VoxtoolError(
            f".{name} takes no level, box, dtype, isovalue or inversion: leave them out"
        )
    if normals and not EXCHANGE[name].normals:
        names = ", ".join(f".{key}" for key, each in EXCHANGE.items() if each.normals)
        raise VoxtoolError(f".{name} holds no normals: choose {names}")
    if leaves and not EXCHANGE[name].hexahedra:
        names = ", ".join(f".{key}" for key, each in EXCHANGE.items() if each.hexahedra)
        raise VoxtoolError(f".{name} holds no hexahedra of leaves: choose {names}")
    check_package(name)
    check_output(path, name, clobber)
    one, tree = EXCHANGE[name].attributes == "one", name == "vtkhdf"  # parts are trees of their own
    other = {
        "--invert": invert,
        # an attribute in place of the occupancy has a type of its own
        "--dtype": dtype is not None and (one or (tree and level > 0)),
        "--isovalue": isovalue is not None and (one or tree),
        "--bbox": bbox is not None and tree,
    }
    other = [option for option, given in other.items() if given]
    held, left_out = chosen_attributes(content, name, attributes, other)
    if chosen and not isinstance(content, OctreeContent):
        raise VoxtoolError(
            "a field, a volume or labels take no level, box, dtype, isovalue or inversion: leave "
            "them out"
        )
    if isinstance(content, DistanceField):
        if lattice is not None:
            if grid is not None:
                raise GridError("a grid and a lattice: give one of them")
            low = np.array(content.origin)
            box = [*low, *(low + content.side)]
            grid = Grid.fit(None, bbox=box, lattice=unit_checked(lattice, content))
        elif grid is not None:
            grid = unit_checked(grid, content)
        image = image_of(content, name, band, shape, spacing, grid)
        image = replace(image, device=device, progress=progress)
    elif not (band is shape is spacing is grid is lattice is None):
        raise VoxtoolError(
            "a band, spacing, shape, grid and lattice go with a distance field: this is none"
        )
    elif isinstance(content, TetVolume):
        if not EXCHANGE[name].volumes:
            names = ", ".join(f".{key}" for key, each in EXCHANGE.items() if each.volumes)
            raise VoxtoolError(f".{name} holds no tetrahedral volume: choose {names}")
        image = VolumeCells(content)
    elif isinstance(content, Labels):
        if not EXCHANGE[name].dense:
            names = ", ".join(f".{key}" for key, each in EXCHANGE.items() if each.dense)
            raise VoxtoolError(f".{name} holds no labels: choose {names}")
        image = content
    else:
        image = VoxelImage.of(
            content, level=level, bbox=bbox, invert=invert, dtype=dtype, isovalue=isovalue
        )
        if name == "png" and options.get("value") is not None:
            image = image.layer(options.get("axis", "z"), options["value"])
        slabs = not (EXCHANGE[name].points or EXCHANGE[name].whole or EXCHANGE[name].hexahedra)
        if EXCHANGE[name].hexahedra and not invert:  # labels are their materials
            held = tuple(one.name for one in content.attributes if one.name == "label")
        image = replace(image, dense=normals or slabs, attributes=held, tree=EXCHANGE[name].whole)
        types = EXCHANGE[name].dtypes
        if not (dtype is isovalue is None) and types and image.dtype.name not in types:
            option = "--isovalue" if dtype is None else "--dtype"
            raise VoxtoolError(
                f".{name} holds {' or '.join(types)}, not {image.dtype.name}: leave out {option}"
            )
        if normals and "normal" in held:
            raise VoxtoolError("normals of the cells and the attribute normal: choose one of them")
        needed = bytes_of(image)
        image = replace(fitting_image(image, max_memory, windows), progress=progress)
        if EXCHANGE[name].whole and isinstance(image, ImageInParts):
            instead = "a plane by --slice" if name == "png" else f"{image.smaller}, or .npz"
            instead += ", or --attribute none" if held else ""
            raise MemoryLimitError(
                f"a .{name} is written from memory, and would need {human(needed)}, of "
                f"{human(image.limit)} allowed: choose {instead} (see --max-memory)"
            )
        if EXCHANGE[name].hexahedra:
            image = hexahedra_of(image, leaves, max_memory)
        elif held and EXCHANGE[name].attributes == "one":
            image = AttributeImage(image, held[0])
    if EXCHANGE[name].folder and "%" in os.fspath(path):
        options["pattern"] = Path(path).name
    more = {"normals": True} if normals else {}
    size = writer_of(name, "size", image)(image, **more)
    plan = ExportPlan(image, name, size, {**options, **more}, reasons=left_out)
    return ExportJob(plan, path, clobber, max_bytes, max_memory)


def hexahedra_of(image: VoxelImage, leaves: bool, max_memory: int | None) -> Hexahedra:
    """Return the hexahedra of cells, or of the largest cubes of them."""
    if not leaves:
        found = Hexahedra.of(image)
        if isinstance(image, ImageInParts):  # which takes what layers do not need
            rest = max(image.limit - found.own_bytes, 1)
            found = replace(found, image=replace(found.image, limit=rest))
        return found
    return LeafHexahedra.of(image, limit=available_memory() if max_memory is None else max_memory)


def image_of(
    source: DistanceField,
    name: str,
    band: float | None,
    shape: Any,
    spacing: Any,
    grid: Grid | None,
) -> LevelSet | FieldSamples:
    """Return what a format holds of a field: a level set, or samples on a grid; VoxtoolError if it
    holds none, or not as requested."""
    format = EXCHANGE[name]
    if format.levels:
        if not (shape is grid is None) or np.ndim(spacing):
            raise VoxtoolError(f".{name} holds a level set: choose it by a band and one spacing")
        return in_single(source, name, LevelSet.of(source, band, spacing))
    if not format.dense:
        names = ", ".join(f".{key}" for key, each in EXCHANGE.items() if each.levels or each.dense)
        raise VoxtoolError(f".{name} holds no distance field: choose {names}")
    if band is not None:
        raise VoxtoolError(f".{name} holds all samples of a grid: a band goes with level sets")
    if grid is not None and not (shape is spacing is None):
        raise VoxtoolError("a grid has its own shape and spacing: leave them out")
    return in_single(source, name, FieldSamples(source, grid or grid_over(source, shape, spacing)))


def in_single(
    source: DistanceField, name: str, image: LevelSet | FieldSamples
) -> LevelSet | FieldSamples:
    """Return the samples of a field; GridError if float32 does not hold its distances there."""
    low = np.array(image.origin)
    high = low + np.array(image.shape) * image.pitch
    far = abs(low - source.origin).sum() + abs(high - low).sum() + 2 * source.side
    check_single(f".{name}", image.pitch, [*low, *high, far], "scale the mesh")
    return image
