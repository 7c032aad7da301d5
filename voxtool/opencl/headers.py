"""The headers that the host generates for the kernels, so that a constant or layout is given once.

A module that shares constants with kernels has a dictionary `HEADERS`, from header names to their
text. Print them with `python -m voxtool.opencl.headers [NAME ...]`.
"""

from __future__ import annotations

import sys
from importlib import import_module

# Header -> the module whose HEADERS holds its text.
HOMES = {
    "adf/levels/level.h": "voxtool.adf.levels",
    "adf/levels/sample_points.h": "voxtool.adf.levels",
    "adf/points.h": "voxtool.adf.host_query",
    "adf/features.h": "voxtool.adf.surface.sharp",
    "adf/hashing.h": "voxtool.adf.hashing",
    "adf/query.h": "voxtool.adf.query",
    "adf/raycast.h": "voxtool.adf.raycast",
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
    "svo/attribution/paint.h": "voxtool.svo.attribution.paint",
    "svo/attribution/pieces.h": "voxtool.svo.attribution.pieces",
    "svo/attribution/colours.h": "voxtool.svo.attribution.surface_pass",
    "svo/attribution/textures.h": "voxtool.svo.attribution.look",
    "svo/booleans.h": "voxtool.svo.booleans",
    "svo/fill/crossings.h": "voxtool.svo.fill.rows",
    "svo/fill/flood.h": "voxtool.svo.fill.pieces",
    "svo/fill/rows.h": "voxtool.svo.fill.rows",
    "svo/fill/winding.h": "voxtool.svo.fill.winding",
    "svo/morton_table.h": "voxtool.svo.scan",
    "svo/morphology.h": "voxtool.svo.morphology",
    "svo/octree.h": "voxtool.svo.layout",
    "svo/nearest.h": "voxtool.svo.query",
    "svo/query.h": "voxtool.svo.query",
    "svo/raycast.h": "voxtool.svo.raycast",
    "svo/resample.h": "voxtool.svo.resample",
    "svo/scan.h": "voxtool.svo.scan",
    "svo/surface/case_tables.h": "voxtool.svo.surface.case_tables",
    "svo/surface/dual_case_tables.h": "voxtool.svo.surface.case_tables",
    "svo/surface/greedy_meshing.h": "voxtool.svo.surface.dual",
    "svo/surface/lattice.h": "voxtool.svo.surface.isosurface",
    "svo/surface/sharp.h": "voxtool.svo.surface.sharp",
    "svo/surface/words.h": "voxtool.svo.surface.words",
    "svo/wall_links.h": "voxtool.svo.wall_links",
    "tets/cells.h": "voxtool.tets.cells",
    "tets/conforming.h": "voxtool.tets.conforming",
    "tets/integrators.h": "voxtool.tets.integrate",
    "tets/order.h": "voxtool.tets.textures",
    "tets/project.h": "voxtool.tets.project",
    "tets/raycast.h": "voxtool.tets.raycast",
    "tets/volume.h": "voxtool.tets.volume",
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
