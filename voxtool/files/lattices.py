"""Grids of files, and meshes placed in them."""

from __future__ import annotations

import os
import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

from voxtool.errors import GridError, MeshWarning
from voxtool.files.formats import IMPORTS
from voxtool.files.storage.streams import PathLike, input_name
from voxtool.grid import Grid
from voxtool.mesh.lengths import conversion, in_units, share_beyond
from voxtool.mesh.mesh import Mesh
from voxtool.units import difference

if TYPE_CHECKING:
    from voxtool.adf.field.field import DistanceField
    from voxtool.svo.octree.content import OctreeContent


class Lattice(NamedTuple):
    """A grid, and the unit of its lengths, or ""."""

    grid: Grid
    units: str = ""


class PlacedMesh(NamedTuple):
    """A mesh in the unit of the grid that was chosen for it, the share of it that lies beyond the
    grid, by area, and a remark if it was scaled."""

    mesh: Mesh
    grid: Grid
    beyond: float = 0.0
    scaled: str = ""


def read_lattice(path: PathLike) -> Lattice:
    """Return the grid of a file that holds voxels: an octree, or another program's."""
    from voxtool.files import open_svo

    if os.fspath(path).lower().endswith(tuple(f".{kind}" for kind in IMPORTS)):
        from voxtool.files.imports import Source

        with Source.of(path).stored() as stored:
            return Lattice(stored.frame.grid, stored.units)
    with open_svo(path) as octree:
        return Lattice(octree.grid, octree.units)


def unit_checked(
    grid: Grid | PathLike | None, content: OctreeContent | DistanceField
) -> Grid | None:
    """Return a grid, or that of a file, for an octree or a field; GridError if their units are
    known and differ."""
    if isinstance(grid, Grid | None):
        return grid
    found = read_lattice(grid)
    what = "octree" if hasattr(content, "grid") else "field"
    if message := difference(
        content.units, found.units, "make them of meshes in one unit (--units)"
    ):
        raise GridError(f"the {what} and the grid of {input_name(grid)} are {message}")
    return found.grid


def placed(
    mesh: Mesh,
    grid: Grid | PathLike | None = None,
    lattice: Grid | PathLike | None = None,
    **fit: Any,
) -> PlacedMesh:
    """Return a mesh and its grid: the one that is given, or one around the mesh.

    Parameters
    ----------
    mesh : Mesh
        The mesh; scaled if its unit and that of the file of a grid are known and differ.
    grid : Grid or path, optional
        The grid itself, or that of a file.
    lattice : Grid or path, optional
        The grid, or the file, whose lattice the grid around the mesh has.
    **fit
        As in Grid.fit, which makes the grid around the mesh.

    Raises
    ------
    GridError
        If there are several grids, or one is out of range.

    Warns
    -----
    MeshWarning
        A part of the mesh lies beyond a grid that is given, or a box.
    """
    fit = {name: value for name, value in fit.items() if value is not None}
    if grid is not None and (fit or lattice is not None):
        raise GridError("a grid has its own dim and pitch: drop dim= and pitch=, or the grid")
    given = lattice if grid is None else grid
    if given is None:
        found, scaled = mesh, ""
        chosen = Grid.fit(mesh, **fit)
    else:
        base = Lattice(given) if isinstance(given, Grid) else read_lattice(given)
        found = in_units(mesh, base.units)
        scaled = conversion(mesh, found, "the grid")
        if not (found.units or found.transform):  # its numbers are taken to be the grid's
            found = replace(found, units=base.units)
        chosen = base.grid if lattice is None else Grid.fit(found, lattice=base.grid, **fit)
    if grid is None and "bbox" not in fit:
        return PlacedMesh(found, chosen, 0.0, scaled)
    beyond = share_beyond(found, chosen)
    if beyond:
        where, hint = "", "choose a larger one"
        if not isinstance(grid, Grid | None):
            where = f" of {input_name(grid)}"
            hint = f"--lattice {input_name(grid)} takes all of it, on the same voxels"
        share = "all" if beyond == 1 else f"{100 * beyond:.3g} %"
        warnings.warn(
            f"{share} of the surface of {found.name or 'the mesh'} lies beyond the grid{where}: "
            f"{hint}",
            MeshWarning,
            stacklevel=3,
        )
    return PlacedMesh(found, chosen, beyond, scaled)
