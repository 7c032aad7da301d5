"""Pages that show content in a browser."""

from __future__ import annotations

import sys
import tempfile
import webbrowser
from collections.abc import Sequence
from pathlib import Path as FilePath
from typing import Any

from voxtool import files
from voxtool.api.octrees import Path, voxelize
from voxtool.files.pictures.page import write_page
from voxtool.mesh.mesh import Mesh
from voxtool.pictures.rendering import Content
from voxtool.svo.surface.isosurface import Isosurface
from voxtool.viewer import job
from voxtool.viewer.job import ViewJob
from voxtool.viewer.page import Page


def plan_view(
    content: Content | Mesh | Isosurface | Path,
    name: str = "",
    *,
    up: Sequence[float] = (0.0, 1.0, 0.0),
    level: int | str = "voxel",
    isovalue: float | None = None,
    max_memory: int | None = None,
) -> ViewJob:
    """Plan a page that shows content in a browser; `run` returns the Page.

    Parameters
    ----------
    content : Octree, DistanceField, TetVolume, Mesh or path
        What the page shows. A mesh is voxelized with the defaults of `voxelize`.
    name : str
        The name that the page shows; by default that of the file.
    up : three floats
        What is up: a direction.
    level : int or "voxel"
        The finest nodes on the page of an octree; those of a level are cubes.
    isovalue : float, optional
        The least share of a node above voxels that is set, on the page of an octree, at first; by
        default any.
    max_memory : int, optional
        Bytes that the work may take; by default what the machine has.

    Returns
    -------
    ViewJob

    Raises
    ------
    FileError
        If the file cannot be read.
    MemoryLimitError
        If the data are more than a page holds.
    VoxtoolError
        If the octree has no such level, the isovalue is no share, or the content is no octree.
    """
    name = name or (str(content) if isinstance(content, str | FilePath) else "")
    found = shown_content(content)
    name = name or type(found).__name__
    return job.plan_view(found, name, up=up, level=level, isovalue=isovalue, max_memory=max_memory)


def view(
    content: Content | Mesh | Isosurface | Path,
    path: Path | None = None,
    *,
    up: Sequence[float] = (0.0, 1.0, 0.0),
    level: int | str = "voxel",
    isovalue: float | None = None,
) -> Page:
    """Show content on an interactive page, in a notebook or in a browser.

    A notebook shows the page that is returned. Elsewhere the page is written, and a browser opens
    it.

    Parameters
    ----------
    content : Octree, DistanceField, TetVolume, Mesh or path
        What the page shows. A mesh is voxelized with the defaults of `voxelize`.
    path : path, optional
        Where the page is written; by default a new file in the folder for temporary files, and in a
        notebook nowhere.
    up : three floats
        What is up: a direction.
    level : int or "voxel"
        The finest nodes on the page of an octree; those of a level are cubes.
    isovalue : float, optional
        The least share of a node above voxels that is set, on the page of an octree, at first; by
        default any.

    Returns
    -------
    Page
        Its `html` is the file.

    Raises
    ------
    FileError
        If a file cannot be read or written.
    MemoryLimitError
        If the data are more than a page holds.
    VoxtoolError
        If the octree has no such level, the isovalue is no share, or the content is no octree.

    Examples
    --------
    >>> voxtool.view("bunny.svo.h5", "bunny.html")
    """
    page = plan_view(content, up=up, level=level, isovalue=isovalue).run()
    notebook = "ipykernel" in sys.modules
    if path is None and not notebook:
        path = FilePath(tempfile.mkdtemp(prefix="voxtool-")) / "view.html"
    if path is not None:
        write_page(page.html, path)
        if not notebook:
            webbrowser.open(FilePath(path).absolute().as_uri())
    return page


def shown_content(content: Any) -> Content:
    """Return what a page of content, or of a file, shows: a mesh is voxelized."""
    if isinstance(content, str | FilePath):
        return voxelize(content) if files.is_mesh(content) else files.read_scene(content)
    return voxelize(content) if isinstance(content, Mesh | Isosurface) else content
