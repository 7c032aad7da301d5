"""voxtool: triangle meshes to exact sparse voxel octrees and distance fields, and pictures of these
and of tetrahedral volumes, with OpenCL, on CPU or GPU.

The public API. Names are imported when they are first used, so that a command starts fast.

>>> m = voxtool.load_mesh("bunny.obj")
>>> g = voxtool.Grid.fit(m, dim=512)
>>> o = voxtool.voxelize(m, g, mode="solid")
>>> o.count, o.digest()
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from voxtool.version import __version__

if TYPE_CHECKING:
    from voxtool.adf.build import build_adf, plan_adf
    from voxtool.adf.field import DistanceField
    from voxtool.adf.query import FieldQuery, query_adf
    from voxtool.camera import Camera, Rays
    from voxtool.distances import distance_grid, plan_distance, plan_distance_grid
    from voxtool.errors import (
        DeviceError,
        FileError,
        GridError,
        MemoryLimitError,
        MeshError,
        VoxtoolError,
    )
    from voxtool.files import (
        export,
        read_adf,
        read_svo,
        read_tet,
        read_unstructured,
        write_adf,
        write_mesh,
        write_svo,
        write_tet,
    )
    from voxtool.files.mesh import load_mesh
    from voxtool.files.picture import write_picture
    from voxtool.files.transfer import read_transfer
    from voxtool.grid import Grid
    from voxtool.mesh.mesh import Mesh, mesh_from_arrays
    from voxtool.opencl import list_devices, open_device
    from voxtool.rendering import camera_for, plan_render, render
    from voxtool.report import Report, diagnose
    from voxtool.spatial.deviation import deviation
    from voxtool.spatial.signed_distance import DistanceResult, SignedDistance, distance
    from voxtool.svo.octree import Octree
    from voxtool.svo.surface.extract import extract, plan_extract
    from voxtool.svo.surface.isosurface import Isosurface
    from voxtool.svo.voxelize import plan_voxelize, voxelize
    from voxtool.tets.mesh import UnstructuredMesh
    from voxtool.tets.textures import build_tet, plan_tet
    from voxtool.tets.transfer import TransferFunction, default_transfer
    from voxtool.tets.volume import TetVolume

_HOMES = {
    "voxtool.adf.build": ("build_adf", "plan_adf"),
    "voxtool.adf.field": ("DistanceField",),
    "voxtool.adf.query": ("FieldQuery", "query_adf"),
    "voxtool.camera": ("Camera", "Rays"),
    "voxtool.distances": ("distance_grid", "plan_distance", "plan_distance_grid"),
    "voxtool.errors": (
        "DeviceError",
        "FileError",
        "GridError",
        "MemoryLimitError",
        "MeshError",
        "VoxtoolError",
    ),
    "voxtool.files": (
        "export",
        "read_adf",
        "read_svo",
        "read_tet",
        "read_unstructured",
        "write_adf",
        "write_mesh",
        "write_svo",
        "write_tet",
    ),
    "voxtool.files.picture": ("write_picture",),
    "voxtool.files.transfer": ("read_transfer",),
    "voxtool.grid": ("Grid",),
    "voxtool.files.mesh": ("load_mesh",),
    "voxtool.mesh.mesh": ("Mesh", "mesh_from_arrays"),
    "voxtool.opencl": ("list_devices", "open_device"),
    "voxtool.report": ("Report", "diagnose"),
    "voxtool.spatial.deviation": ("deviation",),
    "voxtool.spatial.signed_distance": ("DistanceResult", "SignedDistance", "distance"),
    "voxtool.svo.surface.extract": ("extract", "plan_extract"),
    "voxtool.svo.surface.isosurface": ("Isosurface",),
    "voxtool.rendering": ("camera_for", "plan_render", "render"),
    "voxtool.svo.octree": ("Octree",),
    "voxtool.svo.voxelize": ("plan_voxelize", "voxelize"),
    "voxtool.tets.mesh": ("UnstructuredMesh",),
    "voxtool.tets.textures": ("build_tet", "plan_tet"),
    "voxtool.tets.transfer": ("TransferFunction", "default_transfer"),
    "voxtool.tets.volume": ("TetVolume",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "Camera",
    "DeviceError",
    "DistanceField",
    "DistanceResult",
    "FieldQuery",
    "FileError",
    "Grid",
    "GridError",
    "Isosurface",
    "MemoryLimitError",
    "Mesh",
    "MeshError",
    "Octree",
    "Rays",
    "Report",
    "SignedDistance",
    "TetVolume",
    "TransferFunction",
    "UnstructuredMesh",
    "VoxtoolError",
    "__version__",
    "build_adf",
    "build_tet",
    "camera_for",
    "default_transfer",
    "deviation",
    "diagnose",
    "distance",
    "distance_grid",
    "export",
    "extract",
    "list_devices",
    "load_mesh",
    "mesh_from_arrays",
    "open_device",
    "plan_adf",
    "plan_distance",
    "plan_distance_grid",
    "plan_extract",
    "plan_render",
    "plan_tet",
    "plan_voxelize",
    "query_adf",
    "read_adf",
    "read_svo",
    "read_tet",
    "read_transfer",
    "read_unstructured",
    "render",
    "voxelize",
    "write_adf",
    "write_mesh",
    "write_picture",
    "write_svo",
    "write_tet",
]


def __getattr__(name: str) -> object:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'voxtool' has no attribute {name!r}")
    value = getattr(import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
