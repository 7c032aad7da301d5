"""Octrees for solvers: the links of lattices that cross the wall."""

from __future__ import annotations

from voxtool.api.octrees import MeshLike, Path, opened
from voxtool.choices import FLUIDS
from voxtool.files import read_drawn
from voxtool.files.formats import OCTREE
from voxtool.files.meshes.mesh import as_mesh
from voxtool.job import one_call
from voxtool.opencl import Device
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.solvers import wall_links as links
from voxtool.svo.solvers.wall_links import LinksJob, WallLinks
from voxtool.svo.surface.sharp import source_of


def plan_wall_links(
    octree: OctreeContent | Path,
    source: MeshLike,
    lattice: str = "D3Q19",
    fluid: str = FLUIDS[0],
    *,
    device: Device | None = None,
    max_memory: int | None = None,
) -> LinksJob:
    """Find the links of a lattice that cross the wall, and where, for lattice Boltzmann methods.

    A link goes from the centre of a fluid voxel to that of a neighbour that is none of the fluid.
    Its place is the first point of the mesh on it, as a share of the link. Links that leave the
    grid are not listed.

    Parameters
    ----------
    octree : OctreeContent or path
        The voxels.
    source : mesh or path
        The mesh that the octree was made from.
    lattice : str
        "D3Q19" or "D3Q27".
    fluid : str
        "unset": the voxels of the grid that are not set; "set": those that are.
    device, max_memory
        As in voxelize.

    Returns
    -------
    WallLinks
        From `plan_wall_links` the job, whose `run` returns it.

    Raises
    ------
    MeshError
        If the octree was not made from the mesh.
    VoxtoolError
        If the lattice or the fluid is unknown.
    DeviceError
        If the device has no double precision.
    MemoryLimitError
        If it would not fit.

    Warns
    -----
    MeshWarning
        If there is no link, or no triangle crosses some of them.

    References
    ----------
    [Bouzidi 2001]

    Examples
    --------
    >>> links = voxtool.wall_links("bunny.svo.h5", "bunny.obj", "D3Q27")
    >>> links.voxels, links.places, links.flags
    """
    found = opened(octree, lambda path: read_drawn(path, OCTREE))
    mesh = source_of(found, as_mesh(source))
    return links.plan_wall_links(
        found, mesh, lattice, fluid, device=device, max_memory=max_memory
    )  # fmt: skip


wall_links = one_call(plan_wall_links, "wall_links", WallLinks)
