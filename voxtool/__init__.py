"""voxtool: triangle meshes to exact sparse voxel octrees and distance fields, and pictures of these
and of tetrahedral volumes, with OpenCL, on CPU or GPU.

The public API. Names are imported when they are first used, so that a command starts fast.

>>> octree = voxtool.voxelize("bunny.obj", dim=512)
>>> octree.count, octree.digest()
>>> surface = voxtool.extract(octree)
>>> picture = voxtool.render(octree, "front")
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from voxtool.version import __version__

if TYPE_CHECKING:
    from voxtool.api import (
        Camera,
        CheckError,
        Cost,
        Device,
        DeviceError,
        DeviceWarning,
        DistanceField,
        DistanceGridJob,
        DistanceJob,
        DistanceResult,
        ExtractJob,
        FieldJob,
        FieldQuery,
        FileError,
        Grid,
        GridError,
        Isosurface,
        Job,
        MemoryLimitError,
        Mesh,
        MeshError,
        MeshLike,
        MeshWarning,
        Octree,
        Plan,
        QueryResult,
        Rays,
        RenderJob,
        Report,
        SignedDistance,
        TetVolume,
        TransferFunction,
        UnstructuredMesh,
        VolumeJob,
        VoxelizeJob,
        VoxtoolError,
        VoxtoolWarning,
        build_adf,
        build_tet,
        camera_for,
        default_transfer,
        deviation,
        diagnose,
        distance,
        distance_grid,
        export,
        extract,
        list_devices,
        load_mesh,
        mesh_from_arrays,
        open_device,
        plan_adf,
        plan_distance,
        plan_distance_grid,
        plan_extract,
        plan_render,
        plan_tet,
        plan_voxelize,
        query_adf,
        read_adf,
        read_svo,
        read_tet,
        read_transfer,
        read_unstructured,
        render,
        voxelize,
        write_adf,
        write_mesh,
        write_picture,
        write_svo,
        write_tet,
    )

__all__ = [
    "Camera",
    "CheckError",
    "Cost",
    "Device",
    "DeviceError",
    "DeviceWarning",
    "DistanceField",
    "DistanceGridJob",
    "DistanceJob",
    "DistanceResult",
    "ExtractJob",
    "FieldJob",
    "FieldQuery",
    "FileError",
    "Grid",
    "GridError",
    "Isosurface",
    "Job",
    "MemoryLimitError",
    "Mesh",
    "MeshError",
    "MeshLike",
    "MeshWarning",
    "Octree",
    "Plan",
    "QueryResult",
    "Rays",
    "RenderJob",
    "Report",
    "SignedDistance",
    "TetVolume",
    "TransferFunction",
    "UnstructuredMesh",
    "VolumeJob",
    "VoxelizeJob",
    "VoxtoolError",
    "VoxtoolWarning",
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
    if name not in __all__:
        raise AttributeError(f"module 'voxtool' has no attribute {name!r}")
    value = getattr(import_module("voxtool.api"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
