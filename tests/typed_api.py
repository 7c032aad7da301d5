# pyright: strict
"""The public functions as a strict type checker sees them. `make lint` checks this file; nothing
runs it."""

from __future__ import annotations

import numpy as np

import voxtool


def octrees(device: voxtool.Device) -> voxtool.Octree:
    mesh: voxtool.Mesh = voxtool.load_mesh("bunny.obj")
    grid: voxtool.Grid = voxtool.Grid.fit(mesh, 64)
    job: (
        voxtool.VoxelizeJob
        | voxtool.PartLabelsJob
        | voxtool.SurfaceAttributesJob
        | voxtool.FractionJob
    )
    job = voxtool.plan_voxelize(mesh, grid, "solid", fill="flood", gap=1)
    cost: voxtool.Cost = job.with_(gap=2).cost
    octree: voxtool.Octree = job.run(print)
    count: int = octree.count + cost.device
    digest: str = voxtool.voxelize("bunny.obj", dim=64 + count, device=device).digest()
    surface: voxtool.Isosurface = voxtool.extract(octree, style="surface-nets", level="voxel")
    surface = voxtool.plan_extract("bunny.svo.h5", merge=True).run()
    voxtool.write_mesh(surface, digest, normals=surface.normals)
    voxtool.write_svo(octree, "bunny.svo.h5", clobber=False)
    voxtool.export(octree, "slice.png", axis="z", value=3)
    answers: voxtool.OctreeAnswers = voxtool.query_svo(octree, [0, 0, 0], level=0, nearest=True)
    answers = voxtool.OctreeQuery(octree)(answers.nearest)
    inside: np.ndarray = octree.contains([[0, 0, 0]])
    assert inside.shape == answers.contains.shape
    return voxtool.read_svo("bunny.svo.h5")


def distances() -> float:
    field: voxtool.DistanceField = voxtool.build_adf("bunny.obj", tolerance=1e-2)
    field = voxtool.plan_adf("bunny.obj", fill="winding").run()
    voxtool.write_adf(field, "bunny.adf.h5")
    answer: voxtool.QueryResult = voxtool.query_adf(field, [0, 0, 0], gradient=True)
    answer = voxtool.FieldQuery(voxtool.read_adf("bunny.adf.h5"))([[0, 0, 0]])
    measure = voxtool.SignedDistance("bunny.obj", "winding")
    far: np.ndarray = measure([[0, 0, 0]])
    near: voxtool.DistanceResult = voxtool.distance("bunny.obj", far, nearest=True)
    dense: np.ndarray = voxtool.distance_grid("bunny.obj", dim=32, dtype=np.float32)
    dense = voxtool.plan_distance_grid("bunny.obj", dim=32).run()
    assert near.nearest is not None
    return float(answer.distance[0] + near.nearest[0, 0] + dense[0, 0, 0])


def meshes() -> str:
    mesh: voxtool.Mesh = voxtool.mesh_from_arrays([[0, 0, 0]], [[0, 0, 0]])
    report: voxtool.Report = voxtool.diagnose(voxtool.orient(mesh), dim=64, progress=print)
    apart: float = voxtool.deviation(mesh, "bunny.obj")["hausdorff"]
    return f"{report.text()} {apart}"


def pictures() -> np.ndarray:
    mesh: voxtool.UnstructuredMesh = voxtool.read_unstructured("volume.vtu", "density")
    volume: voxtool.TetVolume = voxtool.build_tet(mesh, "raycast")
    voxtool.write_tet(volume, "volume.tet.h5")
    transfer: voxtool.TransferFunction = voxtool.read_transfer("transfer.json")
    picture: np.ndarray = voxtool.render("volume.tet.h5", "front", transfer=transfer)
    camera = voxtool.Camera((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    job: voxtool.RenderJob = voxtool.plan_render(voxtool.read_tet("volume.tet.h5"), camera)
    voxtool.write_picture(picture, "volume.png", bits=16)
    return job.run()


def errors() -> int:
    try:
        voxtool.open_device("cpu")
    except voxtool.DeviceError:
        return len(voxtool.list_devices())
    except (voxtool.MeshError, voxtool.GridError, voxtool.FileError, voxtool.VoxtoolError):
        return 1
    return 0
