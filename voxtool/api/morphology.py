"""Morphology, components and cavities of octrees."""

from __future__ import annotations

from collections.abc import Sequence

from voxtool.api.octrees import Path, opened
from voxtool.choices import ELEMENTS, NEIGHBOURS
from voxtool.files import read_svo
from voxtool.files.lattices import unit_checked
from voxtool.grid import Grid
from voxtool.job import one_call
from voxtool.opencl import Device
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets import components as parts
from voxtool.svo.sets import labels, morphology
from voxtool.svo.sets import resample as resampling
from voxtool.svo.sets import thin as thinning
from voxtool.svo.sets.components import ComponentsJob
from voxtool.svo.sets.labels import LabelJob, Labels
from voxtool.svo.sets.morphology import MorphJob
from voxtool.svo.sets.resample import DEFAULT_THRESHOLD, ResampleJob
from voxtool.svo.sets.thin import ThinJob


def plan_morph(
    octree: Octree | Path,
    operation: str,
    radius: float,
    *,
    world: bool = False,
    shape: str = ELEMENTS[0],
    device: Device | None = None,
    max_memory: int | None = None,
) -> MorphJob:
    """Dilate, erode, open, close or hollow a set of voxels, exactly.

    Parameters
    ----------
    octree
        an Octree or a path.
    operation
        "dilate" (the voxels within the radius of a set one), "erode" (without those within the
        radius of an unset one), "open" (eroded, then dilated), "close" (dilated, then eroded), or
        "shell" (only those within the radius of an unset one). All beyond the grid is unset.
    radius
        in voxels, from centre to centre; from 1 to 128 voxels. Squares are compared exactly, of the
        number as it is given.
    world
        the radius is in world units; voxels need not be cubes.
    shape
        what is within the radius: "ball" (by Euclidean distance), "cube" (by the largest distance
        along an axis), or "cross" (along the axes only).
    device, max_memory
        as voxelize.

    Returns
    -------
    Octree
        of mode "solid" and fill "none"; plan_morph returns the job, whose `run` returns it. Its
        grid is the octree's; a dilation that reaches beyond it grows it on that side, at the low
        sides by multiples of 16 voxels.

    Raises
    ------
    VoxtoolError
        an argument is out of range, or the radius is less than one voxel.
    MemoryLimitError
        the result would not fit. DeviceError : no usable device.

    Warns
    -----
    MeshWarning
        no voxel is left.

    References
    ----------
    [Serra 1982]

    Examples
    --------
    >>> closed = voxtool.morph(octree, "close", 8)
    >>> wall = voxtool.morph(octree, "shell", 1.5, world=True)
    """
    return morphology.plan_morph(
        opened(octree, read_svo), operation, radius, world=world, shape=shape, device=device,
        max_memory=max_memory,
    )  # fmt: skip


morph = one_call(plan_morph, "morph", Octree)


def plan_components(
    octree: Octree | Path, neighbours: int = NEIGHBOURS[0], *, max_memory: int | None = None
) -> LabelJob:
    """Label the connected components of a set of voxels.

    Parameters
    ----------
    octree
        an Octree or a path.
    neighbours
        voxels that are connected: 6 (across faces), 18 (also across edges) or 26 (also across
        corners).
    max_memory
        bytes that may be used; by default what the machine has. The work is done on the host.

    Returns
    -------
    Labels
        the sizes, boxes and centres of the components, the largest first; of two of one size, the
        first one has the first voxel in Morton order. `voxtool.export` writes them as an image of
        whole numbers, 1 for the largest component, 0 where no voxel is set. plan_components returns
        the job, whose `run` returns them.

    Raises
    ------
    VoxtoolError
        an argument is out of range.
    MemoryLimitError
        it would not fit.

    Examples
    --------
    >>> found = voxtool.components(octree)
    >>> len(found), found.sizes[0], found.centers[0], found.boxes[0]
    >>> voxtool.export(found, "labels.nii.gz")
    """
    return labels.plan_components(opened(octree, read_svo), neighbours, max_memory=max_memory)


components = one_call(plan_components, "components", Labels)


def plan_keep_components(
    octree: Octree | Path,
    largest: int | None = None,
    *,
    min_size: int = 1,
    neighbours: int = NEIGHBOURS[0],
    max_memory: int | None = None,
) -> ComponentsJob:
    """Keep the largest connected components of a set of voxels.

    Parameters
    ----------
    octree
        an Octree or a path.
    largest
        how many components stay at most. If two have the same size, the one whose first voxel is
        earlier in Morton order stays. By default all that are large enough.
    min_size
        voxels that a component has at least, or it goes.
    neighbours
        voxels that are connected: 6 (across faces), 18 (also across edges) or 26 (also across
        corners).
    max_memory
        bytes that may be used; by default what the machine has. The work is done on the host.

    Returns
    -------
    Octree
        of mode "solid" and fill "none", on the same grid; plan_keep_components returns the job,
        whose `run` returns it, and whose `sizes` then are the voxels of each component.

    Raises
    ------
    VoxtoolError
        an argument is out of range.
    MemoryLimitError
        it would not fit.

    Warns
    -----
    MeshWarning
        no component is left.

    Examples
    --------
    >>> body = voxtool.keep_components(octree, 1)
    >>> job = voxtool.plan_keep_components("scan.svo.h5", min_size=1000)
    >>> cleaned = job.run()
    >>> job.sizes
    """
    return parts.plan_keep_components(
        opened(octree, read_svo), largest, min_size=min_size, neighbours=neighbours,
        max_memory=max_memory,
    )  # fmt: skip


keep_components = one_call(plan_keep_components, "keep_components", Octree)


def plan_fill_cavities(octree: Octree | Path, *, max_memory: int | None = None) -> ComponentsJob:
    """Fill the cavities of a set of voxels: what the outside does not reach across faces.

    Parameters
    ----------
    octree
        an Octree or a path.
    max_memory
        bytes that may be used; by default what the machine has. The work is done on the host.

    Returns
    -------
    Octree
        of mode "solid" and fill "none", on the same grid; plan_fill_cavities returns the job, whose
        `run` returns it.

    Raises
    ------
    MemoryLimitError
        it would not fit.

    Examples
    --------
    >>> filled = voxtool.fill_cavities(octree)
    """
    return parts.plan_fill_cavities(opened(octree, read_svo), max_memory=max_memory)


fill_cavities = one_call(plan_fill_cavities, "fill_cavities", Octree)


def plan_thin(octree: Octree | Path, *, max_memory: int | None = None) -> ThinJob:
    """Remove the voxels of a surface that it does not need to separate what it separates.

    The result is N-minimal, with N = 26 for mode "surface26" and 6 for "surface6": an N-path joins
    the same unset voxels as before, and without any further voxel it would join more.

    Parameters
    ----------
    octree
        an Octree of mode "surface26" or "surface6", or a path.
    max_memory
        bytes that may be used; by default what the machine has. The work is done on the host.

    Returns
    -------
    Octree
        of the same mode, on the same grid; plan_thin returns the job, whose `run` returns it. All
        beyond the grid is unset. A surface with holes larger than a voxel separates nothing, so
        nothing is left of it.

    Raises
    ------
    VoxtoolError
        the octree is no surface.
    MemoryLimitError
        it would not fit.

    Warns
    -----
    MeshWarning
        most voxels went.

    Examples
    --------
    >>> surface = voxtool.voxelize(mesh, dim=256, mode="surface6")
    >>> minimal = voxtool.thin(surface)
    """
    return thinning.plan_thin(opened(octree, read_svo), max_memory=max_memory)


thin = one_call(plan_thin, "thin", Octree)


def plan_resample(
    octree: Octree | Path,
    grid: Grid | Path | None = None,
    *,
    lattice: Grid | Path | None = None,
    dim: int | None = None,
    pitch: float | None = None,
    bbox: Sequence[float] | None = None,
    threshold: float = DEFAULT_THRESHOLD,
    device: Device | None = None,
    max_memory: int | None = None,
) -> ResampleJob:
    """Resample a set of voxels to another grid, by coverage.

    A voxel of the new grid is set if at least a share of its volume is covered by set voxels. That
    is decided by whole numbers. Pitches and origins are taken as the simplest fractions of one
    another that the rounding of floating point allows. Where these have no small denominator, the
    planes between new voxels are rounded once, to 2**-20 of a new voxel.

    Parameters
    ----------
    octree
        an Octree or a path.
    grid
        the new Grid, or the path of a file whose grid it is, as `voxtool import` reads it.
    lattice
        instead of a grid: a Grid or a path with whose voxels those of the new grid coincide, over
        the octree's box or `bbox`.
    dim
        voxels along the longest side, without a grid.
    pitch
        voxel size in world units, without a grid.
    bbox
        the box X0 Y0 Z0 X1 Y1 Z1 in world units that the grid covers, instead of the octree's; with
        neither dim nor pitch at the octree's pitch.
    threshold
        the share of a voxel that is to be covered, above 0, up to 1; taken as the decimal number
        that it is written as.
    device, max_memory
        as voxelize.

    Returns
    -------
    Octree
        of mode "solid" and fill "none"; plan_resample returns the job, whose `run` returns it.

    Raises
    ------
    VoxtoolError
        the threshold is no share.
    GridError
        the grid is not said, or out of range, or that of a file in another unit.
    MemoryLimitError
        the result would not fit. DeviceError : no usable device.

    Warns
    -----
    MeshWarning
        no voxel is set, or some lie beyond the grid.

    Examples
    --------
    >>> coarse = voxtool.resample(octree, dim=128)
    >>> placed = voxtool.resample(octree, other.grid, threshold=1)
    """
    found = opened(octree, read_svo)
    onto, voxels = (unit_checked(one, found) for one in (grid, lattice))
    return resampling.plan_resample(
        found, onto, lattice=voxels, dim=dim, pitch=pitch, bbox=bbox, threshold=threshold,
        device=device, max_memory=max_memory,
    )  # fmt: skip


resample = one_call(plan_resample, "resample", Octree)
