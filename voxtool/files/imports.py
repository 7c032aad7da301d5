"""Import from the formats of other programs, by the table formats.EXCHANGE: voxels as octrees, and
images of distances as fields.

The module of a format that is read has

    read(file, size) -> Stored    the voxels of a file of `size` bytes that can seek, or of a folder
                                  (a Path), whose files have `size` bytes

It reads a header; the values follow when they are asked for.
"""

from __future__ import annotations

import hashlib
import io
import os
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

from voxtool.adf.construction.from_image import WORK_BYTES, ImageCube, check_request, field_of_image
from voxtool.adf.field.field import DistanceField
from voxtool.choices import DEFAULT_TOLERANCE
from voxtool.errors import FileError, VoxtoolError, one_line
from voxtool.files.formats import (
    ADF_FORMATS,
    EXCHANGE,
    IMAGES,
    IMPORTS,
    SVO_FORMATS,
    TET_FORMATS,
    folder_of,
    format_of,
    function_of,
    is_mesh,
)
from voxtool.files.grids.voxels import PIECE, Rule, Stored, array_of, octree_of
from voxtool.files.storage import streams
from voxtool.files.storage.streams import PathLike
from voxtool.grid import Grid
from voxtool.job import Cost, Job, Plan
from voxtool.memory import at_most, available_memory
from voxtool.opencl import Device
from voxtool.svo.octree.octree import Octree

# Errors in which damage shows while other libraries read.
DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, ValueError, ArithmeticError)
READ, SAMPLE = "read voxels", "sample"
OWN = tuple(f".{name}" for name in (*SVO_FORMATS, *ADF_FORMATS, *TET_FORMATS) if "." in name)


def no_progress(share: float) -> None:
    """Show nothing of the share that is done."""


@dataclass
class Source:
    """A file or a folder of a format.

    Attributes
    ----------
    path : path
        Its name; `-` is stdin.
    name : str
        The format.
    grid : str, optional
        The grid of a file that can hold several.
    held : BytesIO, optional
        The content of what can be read once, after the first time.
    """

    path: PathLike
    name: str
    grid: str | None = None
    held: io.BytesIO | None = None

    @classmethod
    def of(cls, path: PathLike, format: str | None = None, grid: str | None = None) -> Source:
        """Return the source of a name; FileError if there is no such format."""
        name = format or format_of_input(path)
        if name not in IMPORTS:
            raise FileError(f"format {name!r} is unknown: choose one of {', '.join(IMPORTS)}")
        if grid is not None and not EXCHANGE[name].grids:
            raise VoxtoolError(f".{name} holds one grid: leave out its name")
        return cls(path, name, grid)

    @contextmanager
    def stored(self) -> Iterator[Stored]:
        """Yield the voxels; what a library raises of damage becomes one line."""
        read, shown = function_of(self.name, "read"), streams.input_name(self.path)
        options = {} if self.grid is None else {"grid": self.grid}
        try:
            with self.named(), self._opened() as (file, size):
                yield read(file, size, **options)
        except VoxtoolError:
            raise
        except OSError as error:
            raise streams.read_error(shown, error) from error
        except MemoryError as error:
            raise FileError(f"{shown}: more than fits in memory") from error
        except DAMAGE as error:
            raise FileError(f"{shown}: is damaged: {one_line(error)}") from error

    @contextmanager
    def named(self) -> Iterator[None]:
        """Put the name before the errors of this block."""
        try:
            yield
        except VoxtoolError as error:
            raise type(error)(f"{streams.input_name(self.path)}: {error}") from error

    def digest(self) -> str:
        """Return the SHA-256 of the file, or "" of a folder."""
        with self._opened() as (file, _):
            if isinstance(file, Path):
                return ""
            sha = hashlib.sha256()
            while piece := file.read(1 << 20):
                sha.update(piece)
            return sha.hexdigest()

    @contextmanager
    def _opened(self) -> Iterator[tuple[BinaryIO | Path, int]]:
        """Yield the file, or the folder, and its bytes."""
        if EXCHANGE[self.name].folder:
            folder = folder_of(self.path, self.name)
            yield folder, streams.folder_size(folder)
        elif self.held:
            self.held.seek(0)
            yield self.held, self.held.getbuffer().nbytes
        else:
            with streams.open_whole(self.path) as (file, size):
                self.held = file if isinstance(file, io.BytesIO) else None
                yield file, size


@dataclass(frozen=True)
class ImportPlan(Plan):
    """The plan of an import, from the header of a file: its format, grid and unit, and what becomes
    of it, an octree by a rule or a field."""

    facts = ()
    costs = ("host",)
    refusal = (
        "the import {shortage}: import a part of the image, or a coarser one (see --max-memory)"
    )

    name: str
    grid: Grid
    units: str
    rule: Rule
    as_field: bool
    tolerance: float
    max_level: int | None

    @property
    def stages(self) -> tuple[str, ...]:
        return (READ, SAMPLE) if self.as_field else (READ,)

    @property
    def cost(self) -> Cost:
        """On the host, an image of float64 and what samples it, or for an octree the pieces of the
        file; an octree itself grows with what is set, which a header does not say."""
        x, y, z = self.grid.shape
        layers = 4 * 8 * max(x * y, y * z, x * z) if EXCHANGE[self.name].dense else 0
        pieces = 3 * max(PIECE, layers)
        if not self.as_field:
            return Cost(0, host=pieces)
        return Cost(0, host=pieces + 8 * prod(self.grid.shape) + WORK_BYTES)

    @property
    def cube(self) -> ImageCube:
        """The cube of a field."""
        return ImageCube(self.grid)

    def decisions(self) -> dict[str, Any]:
        grid, cube = self.grid, self.cube
        field = {
            "side": cube.side,
            "tolerance": self.tolerance,
            "max_level": self.max_level or cube.default_level,
            "level_of_samples": cube.natural,
        }
        return {
            "format": self.name,
            "shape": list(grid.shape),
            "origin": list(grid.origin),
            "pitch": list(grid.pitch),
            "units": self.units,
            "becomes": "field" if self.as_field else "octree",
            **(field if self.as_field else {}),
            **super().decisions(),
        }

    def rows(self) -> list[tuple[str, str]]:
        grid, cube = self.grid, self.cube
        shape, pitch = (" x ".join(f"{v:.6g}" for v in of) for of in (grid.shape, grid.pitch))
        place = f"from {', '.join(f'{v:.6g}' for v in grid.origin)}"
        rows = [("image", f".{self.name}, {shape} voxels of {pitch}{self.units and ' '}"
                 f"{self.units}, {place}")]  # fmt: skip
        if self.as_field:
            levels = f"levels to {self.max_level or cube.default_level}"
            rows.append((
                "field", f"a cube of {cube.side:.6g}, samples at level {cube.natural}; tolerance "
                f"{self.tolerance:.3g} sides, {levels}",
            ))  # fmt: skip
        else:
            rows.append(("octree", f"dim {grid.dim}; it takes memory by what is set"))
        return rows


@dataclass(eq=False)
class ImportJob(Job[Octree | DistanceField]):
    """A planned import; `run` reads the values and returns an octree or a field."""

    plan: ImportPlan
    source: Source
    device: Device | None = None
    max_memory: int | None = None
    progress: Callable[[float], None] = field(default=no_progress)

    def refuse(self) -> None:
        """Raise MemoryLimitError if the import would take more memory of the host than it may."""
        most = available_memory() if self.max_memory is None else self.max_memory
        self.plan.refuse_beyond(most, most)

    def findings(self, result: Octree | DistanceField) -> Iterator[str]:
        """Yield a warning if no voxel is set."""
        if isinstance(result, Octree) and not result.count:
            shown = streams.input_name(self.source.path)
            yield f"{shown} sets no voxel: no value {self.plan.rule.text}"

    def notes(self, result: Octree | DistanceField) -> Iterator[str]:
        """Yield a remark if every voxel is set, as those of an image of distances are."""
        if isinstance(result, Octree) and result.count == prod(result.grid.shape):
            shown = streams.input_name(self.source.path)
            yield (
                f"{shown} sets every voxel, since every value {self.plan.rule.text}: --threshold "
                "and --label choose some, --as-field reads distances"
            )

    def _run(self) -> Octree | DistanceField:
        with at_most(self.max_memory):
            return self._imported()

    def _imported(self) -> Octree | DistanceField:
        plan, most = self.plan, self.max_memory
        with self.stage(READ), self.source.stored() as stored:
            stored = stored._replace(frame=stored.frame._replace(grid=plan.grid))
            if not plan.as_field:
                return octree_of(stored, plan.rule, self.progress, most)
            values = array_of(stored, most, self.progress)
        with self.stage(SAMPLE), self.source.named():
            return field_of_image(
                values, plan.grid, tolerance=plan.tolerance, max_level=plan.max_level,
                units=plan.units, source_sha256=self.source.digest(), device=self.device,
                max_memory=most, progress=self.progress,
            )  # fmt: skip


def plan_import(
    path: PathLike,
    *,
    as_field: bool = False,
    threshold: float | None = None,
    label: float | None = None,
    tolerance: float | None = None,
    max_level: int | None = None,
    origin: Sequence[float] | None = None,
    pitch: Sequence[float] | float | None = None,
    format: str | None = None,
    grid: str | None = None,
    max_memory: int | None = None,
    device: Device | None = None,
    progress: Callable[[float], None] = no_progress,
) -> ImportJob:
    """Return the job of read_voxels, or with `as_field` that of read_field; it reads the header."""
    if threshold is not None and label is not None:
        raise VoxtoolError("a threshold and a label both say what is set: give one of them")
    if as_field and not (threshold is label is grid is None):
        raise VoxtoolError("a threshold, a label and a grid are of octrees: leave them out")
    if not as_field and not (tolerance is max_level is None):
        raise VoxtoolError("a tolerance and a level are of fields: leave them out")
    source = Source.of(path, format, grid)
    if as_field and source.name not in IMAGES:
        held = ", ".join(f".{name}" for name in IMAGES)
        raise FileError(f".{source.name} does not become a field: choose one of {held}")
    tolerance = DEFAULT_TOLERANCE if tolerance is None else tolerance
    check_request(tolerance, max_level)
    with at_most(max_memory), source.stored() as stored:
        own = stored.frame.grid
        place = own.origin if origin is None else origin
        size = own.pitch if pitch is None else pitch
        placed = Grid(own.shape, place, size)  # pyright: ignore[reportArgumentType]
        placed.check_resolution()
        rule = stored.rule if threshold is None and label is None else Rule(threshold, label)
    plan = ImportPlan(source.name, placed, stored.units, rule, as_field, tolerance, max_level)
    return ImportJob(plan, source, device if as_field else None, max_memory, progress)


def read_voxels(
    path: PathLike,
    *,
    threshold: float | None = None,
    label: float | None = None,
    origin: Sequence[float] | None = None,
    pitch: Sequence[float] | float | None = None,
    format: str | None = None,
    grid: str | None = None,
    max_memory: int | None = None,
    progress: Callable[[float], None] = no_progress,
) -> Octree:
    """Read another program's voxels, which become an octree of mode "solid".

    Parameters
    ----------
    path : path
        A file or a folder of a format that `voxtool import -h` lists; `-` is stdin.
    threshold : float, optional
        Values from this one on are set, instead of those that are not 0.
    label : float, optional
        Values equal to this one are set.
    origin : (3,) sequence of float, optional
        World coordinates of the low corner, instead of those in the file.
    pitch : float or (3,) sequence of float, optional
        World size of a voxel, instead of that in the file.
    format : str, optional
        The format, instead of what the name says.
    grid : str, optional
        The grid of a file that can hold several.
    max_memory : int, optional
        Bytes that the octree may take while it is collected; by default those that are free.
    progress : callable, optional
        Called with the share of the voxels that has been read, from 0 to 1.

    Returns
    -------
    Octree

    Raises
    ------
    FileError
        If the file is missing, damaged or hostile, holds no voxels, or its axes are oblique; or if
        the package that reads it is not installed.
    GridError
        If its grid is out of range.
    MemoryLimitError
        If it takes more memory than is allowed.
    VoxtoolError
        If a threshold and a label are given.
    """
    job = plan_import(
        path, threshold=threshold, label=label, origin=origin, pitch=pitch, format=format,
        grid=grid, max_memory=max_memory, progress=progress,
    )  # fmt: skip
    octree = job.run()
    assert isinstance(octree, Octree)
    return octree


def read_field(
    path: PathLike,
    *,
    tolerance: float | None = None,
    max_level: int | None = None,
    origin: Sequence[float] | None = None,
    pitch: Sequence[float] | float | None = None,
    format: str | None = None,
    max_memory: int | None = None,
    device: Device | None = None,
    progress: Callable[[float], None] = no_progress,
) -> DistanceField:
    """Read an image of signed distances, which becomes a field.

    The field is the image's trilinear interpolation, sampled adaptively. The bound of a leaf holds
    against that interpolation. Beyond its samples the image is continued by the nearest ones, up to
    the cube of the field, whose side is a power of two of the image's least spacing.

    Parameters
    ----------
    path : path
        A dense image: .npy, .npz, .vti, .nii, .nii.gz, .nrrd or .tif; `-` is stdin. Its values are
        distances in world units, negative inside, at the centres of its voxels.
    tolerance : float, optional
        Difference of a cell from that interpolation at which it is no longer refined, in sides of
        the cube; by default 1e-3.
    max_level : int, optional
        Level at which leaves are no longer refined, 1 to 21; by default that of the samples, and
        two more where spacings along the axes are no multiples of the least one.
    origin, pitch, format, max_memory, progress
        As in read_voxels.
    device : Device, optional
        Where the hash is built; the default device if None.

    Returns
    -------
    DistanceField
        Its sign is "given", or "none" if no distance is negative. Neighbours of different levels
        may differ by the tolerance.

    Raises
    ------
    FileError
        As read_voxels, or if the file is no dense image.
    GridError
        If its grid is out of range.
    MemoryLimitError
        If image and field take more memory than is allowed.
    VoxtoolError
        If a value is not finite or beyond 1024 sides, or a number is out of range.
    """
    job = plan_import(
        path, as_field=True, tolerance=tolerance, max_level=max_level, origin=origin, pitch=pitch,
        format=format, max_memory=max_memory, device=device, progress=progress,
    )  # fmt: skip
    found = job.run()
    assert isinstance(found, DistanceField)
    return found


def format_of_input(path: PathLike) -> str:
    """Return the format that the name of a file of other programs says; FileError if none."""
    shown = streams.input_name(path)
    if is_mesh(path) and not shown.lower().endswith(".xyz"):
        raise FileError(f"{shown} is a mesh: voxelize it: voxtool voxelize {shown}")
    if os.fspath(path).lower().endswith(OWN):
        raise FileError(f"{shown} is a file of voxtool, which needs no import")
    if path == streams.STREAM:
        raise FileError(f"{shown} has no name: give --from, one of {', '.join(IMPORTS)}")
    with suppress(FileError):
        return format_of(path, IMPORTS)
    raise FileError(
        f"{shown}: its name says no format that is read: give --from, one of {', '.join(IMPORTS)}"
    )
