"""Measure how volumes and areas of voxels converge: the tables of docs/accuracy.md.

    python examples/convergence.py [--dims 32,64,128] [--placements 64]

Closed meshes of known volume V and area integrals are voxelized at several dims, each at several
random placements in the grid. The script prints the root mean square and the largest relative
error of the volume of `solid`, and the number of voxels of `surface26` and `surface6` times the
area of a voxel's face, divided by their limits: the integrals of |nx| + |ny| + |nz| and of
max(|nx|, |ny|, |nz|).
"""

import argparse

import numpy as np

import voxtool


def patches(n, point):
    """A surface over the unit square, closed or degenerate at its sides: vertices and faces."""
    u, v = np.meshgrid(*(np.linspace(0, 1, k + 1) for k in n), indexing="ij")
    vertices = np.stack(point(2 * np.pi * u, 2 * np.pi * v), axis=-1)
    vertices[-1], vertices[:, -1] = vertices[0], vertices[:, 0]
    at = np.arange(vertices[..., 0].size).reshape(n[0] + 1, n[1] + 1)
    a, b, c, d = (x.ravel() for x in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return vertices.reshape(-1, 3), faces


def torus(u, v):
    ring = 2 + np.cos(v)
    return ring * np.cos(u), ring * np.sin(u), np.sin(v)


def sphere():
    """A cube's faces, blown up."""
    s = np.tan(np.linspace(-np.pi / 4, np.pi / 4, 97))
    a, b = np.meshgrid(s, s, indexing="ij")
    parts = []
    for axis in range(3):
        for side in (1.0, -1.0):
            p = np.roll(np.stack([np.full_like(a, side), side * a, b], axis=-1), axis, axis=-1)
            parts.append(p / np.sqrt((p * p).sum(axis=-1, keepdims=True)))
    k = len(s)
    at = np.arange(k * k).reshape(k, k)
    quad = [x.ravel() for x in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:])]
    faces = np.concatenate([np.stack([quad[i] for i in t], 1) for t in ((0, 1, 2), (0, 2, 3))])
    points = np.round(np.concatenate(parts).reshape(-1, 3), 12)  # sides meet bit by bit
    return points, np.concatenate([faces + i * k * k for i in range(6)])


def cube():
    corners = np.indices((2, 2, 2)).reshape(3, -1).T * 2.0 - 1.0
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def integrals(vertices, faces):
    """Return a closed mesh's volume, and the integrals of |nx| + |ny| + |nz| and max |n|."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    n = np.abs(np.cross(b - a, c - a)) / 2
    return abs((np.cross(a, b) * c).sum()) / 6, n.sum(), n.max(axis=1).sum()


def main():
    parser = argparse.ArgumentParser(description="Convergence of volumes and areas of voxels.")
    parser.add_argument("--dims", default="32,64,128,256,512")
    parser.add_argument("--placements", type=int, default=64)
    arguments = parser.parse_args()
    dims = [int(d) for d in arguments.dims.split(",")]
    rng = np.random.default_rng(5)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    device = voxtool.open_device()
    for name, (vertices, faces) in {
        "sphere": sphere(), "torus": patches((512, 256), torus), "cube": cube()
    }.items():  # fmt: skip
        mesh = voxtool.mesh_from_arrays((vertices[:, None] * turn).sum(axis=2), faces)
        volume, area26, area6 = integrals(mesh.vertices, mesh.faces)
        print(f"{name}, {len(faces):,} triangles, turned\n dim   rms error  largest  order"
              "  surface26  surface6")  # fmt: skip
        before = None
        for dim in dims:
            errors, thick, thin = [], 0, 0
            for _ in range(arguments.placements):
                grid = voxtool.Grid.fit(mesh, dim=dim)
                pitch = grid.pitch[0]
                origin = np.array(grid.origin) + pitch * rng.uniform(-0.5, 0.5, 3)
                grid = voxtool.Grid(grid.shape, tuple(origin), grid.pitch)
                count = [
                    voxtool.voxelize(mesh, grid, mode, fill="parity", device=device).count
                    for mode in ("solid", "surface26", "surface6")
                ]
                errors.append(count[0] * pitch**3 / volume - 1)
                thick += count[1] * pitch**2 / area26 / arguments.placements
                thin += count[2] * pitch**2 / area6 / arguments.placements
            rms, largest = np.sqrt(np.mean(np.square(errors))), np.max(np.abs(errors))
            order = (
                f"{np.log(before[1] / rms) / np.log(dim / before[0]):6.2f}" if before else " " * 6
            )
            print(f"{dim:4}   {rms:9.1e}  {largest:.1e} {order}  {thick:9.4f} {thin:9.4f}")
            before = dim, rms


if __name__ == "__main__":
    main()
