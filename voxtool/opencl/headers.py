"""The headers that the host generates for the kernels, so that a constant or layout is given once.

A module that shares constants with kernels has a dictionary `HEADERS`, from header names to their
text. Print them with `python -m voxtool.opencl.headers [NAME ...]`.
"""

from __future__ import annotations

import sys
from importlib import import_module

# Header -> the module whose HEADERS holds its text.
HOMES = {
    "adf/construction/level.h": "voxtool.adf.construction.stages",
    "adf/construction/sample_points.h": "voxtool.adf.construction.stages",
    "adf/field/points.h": "voxtool.adf.field.host_query",
    "adf/surface/features.h": "voxtool.adf.surface.sharp",
    "adf/field/hashing.h": "voxtool.adf.field.hashing",
    "adf/queries/query.h": "voxtool.adf.queries.query",
    "adf/pictures/raycast.h": "voxtool.adf.pictures.raycast",
    "mesh/counts.h": "voxtool.mesh.counts",
    "mesh/watertight.h": "voxtool.mesh.watertight",
    "opencl/primitives.h": "voxtool.opencl.primitives",
    "spatial/arctangent.h": "voxtool.spatial.pseudonormals",
    "spatial/bvh.h": "voxtool.spatial.bvh",
    "spatial/crossings.h": "voxtool.spatial.crossings",
    "spatial/fans.h": "voxtool.spatial.fans",
    "spatial/insides.h": "voxtool.spatial.insides",
    "spatial/names.h": "voxtool.spatial.bvh",
    "spatial/nearest_packets.h": "voxtool.spatial.distance",
    "spatial/self_intersections.h": "voxtool.spatial.self_intersections",
    "spatial/winding_number.h": "voxtool.spatial.winding_number",
    "svo/attribution/fraction.h": "voxtool.svo.attribution.fraction_rows",
    "svo/sets/priority_union.h": "voxtool.svo.sets.priority_union",
    "svo/voxelization/part_pieces.h": "voxtool.svo.voxelization.part_pieces",
    "svo/attribution/colours.h": "voxtool.svo.attribution.surface_pass",
    "svo/attribution/textures.h": "voxtool.svo.attribution.materials",
    "svo/sets/booleans.h": "voxtool.svo.sets.booleans",
    "svo/voxelization/fill/crossings.h": "voxtool.svo.voxelization.fill.rows",
    "svo/voxelization/fill/flood.h": "voxtool.svo.voxelization.fill.flood_pieces",
    "svo/voxelization/fill/rows.h": "voxtool.svo.voxelization.fill.rows",
    "svo/voxelization/fill/winding.h": "voxtool.svo.voxelization.fill.winding",
    "svo/voxelization/morton_table.h": "voxtool.svo.voxelization.scan_conversion",
    "svo/sets/morphology.h": "voxtool.svo.sets.morphology",
    "svo/octree/octree.h": "voxtool.svo.octree.layout",
    "svo/queries/nearest.h": "voxtool.svo.queries.query",
    "svo/queries/query.h": "voxtool.svo.queries.query",
    "svo/pictures/raycast.h": "voxtool.svo.pictures.raycast",
    "svo/sets/resample.h": "voxtool.svo.sets.resample",
    "svo/voxelization/scan_conversion_constants.h": "voxtool.svo.voxelization.scan_conversion",
    "svo/surface/case_tables.h": "voxtool.svo.surface.case_tables",
    "svo/surface/dual_case_tables.h": "voxtool.svo.surface.case_tables",
    "svo/surface/greedy_meshing.h": "voxtool.svo.surface.dual",
    "svo/surface/lattice.h": "voxtool.svo.surface.isosurface",
    "svo/surface/sharp.h": "voxtool.svo.surface.sharp",
    "svo/surface/words.h": "voxtool.svo.surface.words",
    "svo/solvers/wall_links.h": "voxtool.svo.solvers.wall_links",
    "tets/volume/cells.h": "voxtool.tets.volume.cells",
    "tets/construction/conforming.h": "voxtool.tets.construction.conforming",
    "tets/pictures/integrators.h": "voxtool.tets.pictures.integrate",
    "tets/construction/order.h": "voxtool.tets.construction.textures",
    "tets/pictures/project.h": "voxtool.tets.pictures.project",
    "tets/pictures/raycast.h": "voxtool.tets.pictures.raycast",
    "tets/volume/volume.h": "voxtool.tets.volume.volume",
}


def generated(name: str) -> str:
    """Return the text of a generated header."""
    return import_module(HOMES[name]).HEADERS[name]


def main(names: list[str]) -> None:
    """Print the headers of these names, or all."""
    for name in names or HOMES:
        if name not in HOMES:
            sys.exit(f"{name}: no generated header: choose from {', '.join(HOMES)}")
        print(f"// {name}, from {HOMES[name]}\n{generated(name)}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
