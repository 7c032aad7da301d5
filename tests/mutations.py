"""Show which test fails for a fault: each mutation changes one place of the product.

    python tests/mutations.py [NAME ...]

Each mutation is applied to a copy of the checkout, in which the tests of its part run on one
driver until one fails. The script prints the first failing test, and exits 1 if a fault survives.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]


class Mutation(NamedTuple):
    """A text that occurs once in a file, what replaces it, and where tests should notice."""

    file: str
    old: str
    new: str
    tests: str


MUTATIONS: dict[str, Mutation] = {
    # kernels: voxels
    "ties between axes": Mutation(
        "kernels/svo/voxelization/overlap.h",
        "x != 0 ? x : y != 0 ? y : z;",
        "x != 0 ? x : z != 0 ? z : y;",
        "tests/svo/voxelization/test_voxelize.py tests/svo/voxelization/fill",
    ),
    "boxes that a triangle touches": Mutation(
        "kernels/svo/voxelization/scan_conversion.cl",
        "k <= last && !is_positive(near)",
        "k <= last && is_negative(near)",
        "tests/svo/voxelization/test_voxelize.py",
    ),
    "6-separating ties": Mutation(
        "kernels/svo/voxelization/scan_conversion.cl",
        "wide_product(tie < 0, -1)",
        "wide_product(tie < 0, 0)",
        "tests/svo/voxelization/test_voxelize.py",
    ),
    "parity, 1/256 voxel aside": Mutation(
        "kernels/svo/voxelization/fill/crossings.cl",
        "(long)c->low.z * VOXEL + HALF - u.x,",
        "(long)c->low.z * VOXEL + HALF - 1 - u.x,",
        "tests/svo/voxelization/fill tests/svo/voxelization/test_voxelize.py",
    ),
    "corners on edges of voxels": Mutation(
        "kernels/svo/attribution/fraction.cl",
        "slope < 0 ? (double2)(over, -slope)",
        "slope < 0 ? (double2)(-over, -slope)",
        "tests/svo/attribution/test_fine_lattice.py",
    ),
    "a lattice of each bar's own": Mutation(
        "voxtool/tiles/fractions.py",
        '"bits": plan.solid.bits, ',
        "",
        "tests/tiles/test_attributes.py",
    ),
    "the last of crossings at a voxel": Mutation(
        "kernels/svo/voxelization/fill/crossings.cl",
        "nonzero ? number != 0 : number > 0",
        "nonzero ? number > 0 : number > 0",
        "tests/svo/voxelization/fill",
    ),
    "winding: the row up to a voxel": Mutation(
        "kernels/svo/voxelization/fill/winding/near.h",
        "((ulong)(i + 2) << 2)",
        "((ulong)(i + 1) << 2)",
        "tests/svo/voxelization/fill",
    ),
    "winding: a box that a cap may cross": Mutation(
        "kernels/svo/voxelization/fill/winding/blocks.cl",
        "least > reach + slack || most < -reach - slack",
        "least > slack || most < -slack",
        "tests/svo/voxelization/fill",
    ),
    # kernels: surfaces
    "marching cubes: orientation of an edge": Mutation(
        "kernels/svo/surface/samples.h",
        "return is_inside ? LATTICE - kept : kept;",
        "return kept;",
        "tests/svo/surface",
    ),
    "marching cubes: the edge of a triangle": Mutation(
        "kernels/svo/surface/marching_cubes.cl",
        "vertex[PLACE[bit] + offset] = before",
        "vertex[PLACE[bit] + offset] = 1 + before",
        "tests/svo/surface",
    ),
    "nets: a face pinched on both sides": Mutation(
        "kernels/svo/surface/dual.cl",
        "PINCHED_FACE[case_at(THESE_TILES, adjacent)] == (face ^ 1)",
        "PINCHED_FACE[case_at(THESE_TILES, adjacent)] == NO_FACE",
        "tests/svo/surface",
    ),
    "nets: the shorter diagonal": Mutation(
        "kernels/svo/surface/dual.cl",
        "squared(point[2] - point[0]) <= squared(point[3] - point[1])",
        "squared(point[2] - point[0]) >= squared(point[3] - point[1])",
        "tests/svo/surface",
    ),
    # kernels: fields and distances
    "field: the bound without its bend": Mutation(
        "kernels/adf/construction/bounds.h",
        "highest(size - d) + bend;",
        "highest(size - d);",
        "tests/adf/construction/test_build.py",
    ),
    "field: cells beyond the band": Mutation(
        "kernels/adf/construction/examine.cl",
        "c.middle - c.radius > band",
        "c.middle + c.radius > band",
        "tests/adf/construction/test_build.py",
    ),
    "query: gradients of a leaf": Mutation(
        "kernels/adf/queries/query.cl",
        "to_floats((ints)2 << load(level + i))",
        "to_floats((ints)1 << load(level + i))",
        "tests/adf/queries/test_query.py",
    ),
    "distance: rounding of boxes": Mutation(
        "kernels/spatial/distance.cl",
        "(BOX)1 + (sizeof",
        "(BOX)1 - (sizeof",
        "tests/spatial/test_distance.py",
    ),
    "distance: the corner of a triangle": Mutation(
        "kernels/spatial/point_triangle.h",
        "ac > 0.0 ? (MASKS)CA : (MASKS)A;",
        "(MASKS)CA;",
        "tests/spatial/test_signed_distance.py tests/spatial/test_distance.py",
    ),
    "distance: rounding of triangles": Mutation(
        "kernels/spatial/nearest_packets.cl",
        "#define DOUBT 0x1p-15f",
        "#define DOUBT -0x1p-15f",
        "tests/spatial/test_distance.py",
    ),
    "distance: rounding of oriented boxes": Mutation(
        "kernels/spatial/oriented_boxes.h",
        "#define WIDER 0x1p-17",
        "#define WIDER -0x1p-9",
        "tests/spatial/test_distance.py",
    ),
    "distance: sides across holes": Mutation(
        "kernels/spatial/insides.cl",
        "sqrt(square) * slope < leeway",
        "leeway < 1",
        "tests/spatial/test_insides.py",
    ),
    "distance: sides across faces": Mutation(
        "kernels/spatial/insides.cl",
        "clear * clear * ROUNDED",
        "4 * clear * clear * ROUNDED",
        "tests/spatial/test_insides.py",
    ),
    "fields: rounding of triangles": Mutation(
        "kernels/adf/construction/narrow.h",
        "#define DOUBT 0x1p-19f",
        "#define DOUBT 0x1p-27f",
        "tests/adf/construction/test_levels.py",
    ),
    "distance: ties in packets": Mutation(
        "kernels/spatial/nearest_packets.cl",
        "convert_long16(rank < p->rank)",
        "convert_long16(rank > p->rank)",
        "tests/spatial",
    ),
    "self-intersections: coplanar triangles": Mutation(
        "kernels/spatial/self_intersections.cl",
        "return !beyond_edge(a, b) && !beyond_edge(b, a);",
        "return !beyond_edge(a, b);",
        "tests/spatial/test_self_intersections.py",
    ),
    "self-intersections: signs in integers": Mutation(
        "kernels/spatial/exact_sides.h",
        "return side != 0 || most == 0 ? side : exact_side(of, d);",
        "return side;",
        "tests/spatial/test_self_intersections.py",
    ),
    # kernels: volumes and primitives
    "segments: a rounded sum": Mutation(
        "kernels/tets/pictures/segment.h",
        "lost = small - (sum - big);",
        "lost = 0.0f;",
        "tests/tets/pictures/test_segment.py",
    ),
    "segments: a coefficient": Mutation(
        "kernels/tets/pictures/segment.h",
        "0.0166665912f",
        "0.0166765912f",
        "tests/tets/pictures/test_segment.py",
    ),
    "ray casting: oblique rays": Mutation(
        "kernels/tets/pictures/raycast.cl",
        "(depth - place->depth) * rays->length;",
        "depth - place->depth;",
        "tests/tets/pictures/test_pictures.py",
    ),
    "isosurfaces: the side that is lit": Mutation(
        "kernels/tets/pictures/surfaces.h",
        "dot3(g, way) > 0 ? -1.0 : 1.0",
        "dot3(g, way) > 0 ? -1.0 : -1.0",
        "tests/tets/pictures/test_surfaces.py",
    ),
    "isosurfaces: the share in front": Mutation(
        "kernels/tets/pictures/surfaces.h",
        "(to != from ? to - from : (floats)1)",
        "(to != from ? from - to : (floats)1)",
        "tests/tets/pictures/test_surfaces.py",
    ),
    "sampler: the texels of an octant": Mutation(
        "kernels/adf/queries/query.cl",
        "3u * place + (uint3)(octant & 1,",
        "3u * place + (uint3)(0,",
        "tests/adf/queries/test_sampler.py",
    ),
    "scan: the total": Mutation(
        "kernels/opencl/scan.cl",
        "i < ITEMS && start + i <= count",
        "i < ITEMS && start + i < count",
        "tests/opencl/test_primitives.py",
    ),
    "radix sort: digits of a block": Mutation(
        "kernels/opencl/radix_sort.cl",
        "atomic_inc(&found[digit_of(keys[i], shift, digits)]);",
        "atomic_inc(&found[digit_of(keys[start], shift, digits)]);",
        "tests/opencl/test_primitives.py",
    ),
    # host code
    "grid: ties of rounding": Mutation(
        "voxtool/grid.py",
        "np.rint(scaled, out=scaled)",
        "np.floor(scaled + 0.5, out=scaled)",
        "tests/test_grid.py tests/svo/voxelization/test_voxelize.py",
    ),
    "prune: active nodes stay": Mutation(
        "voxtool/svo/octree/prune.py",
        "            stays[np.searchsorted(codes, active)] = True\n",
        "",
        "tests/svo",
    ),
    "pages: leaves wholly inside": Mutation(
        "voxtool/viewer/octrees.py",
        "held, refined = parents | level.inside, parents",
        "held, refined = parents, parents",
        "tests/viewer/test_page.py",
    ),
    "pages: bytes plane by plane": Mutation(
        "voxtool/viewer/page.py",
        "reshape(-1, little.itemsize).T\n",
        "reshape(-1, little.itemsize)\n",
        "tests/viewer/test_page.py",
    ),
    "atomic files: synced before the rename": Mutation(
        "voxtool/files/storage/atomic.py",
        "    _sync(temporary, os.O_RDWR)\n",
        "",
        "tests/files/storage/test_atomic.py",
    ),
    "atomic files: nothing left behind": Mutation(
        "voxtool/files/storage/atomic.py",
        "                temporary.unlink(missing_ok=True)",
        "                pass",
        "tests/files/storage/test_atomic.py",
    ),
    "HDF5: data that the file does not have": Mutation(
        "voxtool/files/storage/hdf5.py",
        "if stored != needed or start is None or start + needed > size:",
        "if False:",
        "tests/files",
    ),
    "octree: voxels beyond the shape": Mutation(
        "voxtool/svo/octree/validate.py",
        "(octree.bricks[edge] & ~allowed) != 0",
        "(octree.bricks[edge] & ~allowed) == ~allowed",
        "tests/files tests/svo/octree/test_octree.py",
    ),
    "jobs: a limit of memory": Mutation(
        "voxtool/job.py",
        "most if self.max_memory is None else self.max_memory",
        "most",
        "tests/adf/construction/test_job.py tests/svo/voxelization/test_voxelize.py "
        "tests/cli/test_main.py",
    ),
    "launches: integers that wrap around": Mutation(
        "voxtool/opencl/launch.py",
        'packed.dtype.kind == "f" or (packed[: self.width] == components).all()',
        "True",
        "tests/opencl/test_launch.py",
    ),
    "OBJ: indices that count back": Mutation(
        "voxtool/files/meshes/obj.py",
        "np.cumsum(is_vertex)[is_face]",
        "np.full(is_face.sum(), is_vertex.sum())",
        "tests/mesh/test_mesh.py",
    ),
}


def run(name: str, mutation: Mutation) -> bool:
    """Print which test fails; return whether one does."""
    with tempfile.TemporaryDirectory(prefix="voxtool-mutant-") as folder:
        copy = Path(folder, "checkout")
        ignored = shutil.ignore_patterns(
            ".git", ".venv", "build", "dist", "__pycache__", ".*_cache"
        )
        shutil.copytree(ROOT, copy, ignore=ignored, symlinks=True)
        file = copy / mutation.file
        text = file.read_text(encoding="utf-8").replace(mutation.old, mutation.new)
        file.write_text(text, encoding="utf-8")
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "--quick", "-x", "-q", "-p", "no:cacheprovider",
             "--hypothesis-profile=first failure",
             *mutation.tests.split()],
            cwd=copy,
            env={**os.environ, "PYTHONPATH": str(copy)},
            capture_output=True,
            text=True,
        )  # fmt: skip
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    print(f"{name:<36} {failed[1] if failed else 'SURVIVES'}", flush=True)
    return failed is not None


def main() -> None:
    for name, mutation in MUTATIONS.items():
        count = (ROOT / mutation.file).read_text(encoding="utf-8").count(mutation.old)
        if count != 1:
            sys.exit(f"{name}: {mutation.old!r} occurs {count} times in {mutation.file}")
    names = sys.argv[1:] or list(MUTATIONS)
    survivors = [name for name in names if not run(name, MUTATIONS[name])]
    sys.exit(f"survive: {', '.join(survivors)}" if survivors else 0)


if __name__ == "__main__":
    main()
