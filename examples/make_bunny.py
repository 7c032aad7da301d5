"""Make an example mesh: a rabbit, sitting, of about 70,000 triangles.

    python examples/make_bunny.py [-o bunny.obj] [--triangles N]

The rabbit is a smooth union of ellipsoids, polygonised by surface nets: one vertex in each cell of
a lattice that the surface crosses, one quad across each edge of the lattice that it crosses. The
vertices then slide along the surface until they are evenly spread. The mesh is closed, manifold,
of genus 0, and oriented outward; y is up, the nose points along x, and the rabbit is 2.3 high.

Only + - * / and the square root decide where a vertex lies, so every machine writes the same file.
"""

import argparse
from pathlib import Path

import numpy as np

LOW, HIGH = np.array([-0.95, -0.06, -0.75]), np.array([1.05, 2.45, 0.75])
BLOCK = 4  # lattice cells along a side of the blocks that are visited first

# centre, radii, softness of the union; parts off the plane z = 0 are mirrored
PARTS = [
    ((-0.17, 0.52, 0.00), (0.56, 0.50, 0.45), 0.00),  # rump
    ((0.18, 0.66, 0.00), (0.35, 0.50, 0.33), 0.20),  # chest
    ((-0.13, 0.35, 0.31), (0.38, 0.34, 0.24), 0.06),  # haunches
    ((0.14, 0.09, 0.43), (0.34, 0.10, 0.12), 0.06),  # hind feet
    ((0.43, 0.37, 0.155), (0.12, 0.38, 0.105), 0.08),  # fore legs
    ((0.54, 0.08, 0.16), (0.19, 0.09, 0.10), 0.05),  # fore paws
    ((-0.74, 0.34, 0.00), (0.19, 0.19, 0.19), 0.06),  # tail
    ((0.34, 1.24, 0.00), (0.38, 0.33, 0.33), 0.14),  # head
    ((0.50, 1.12, 0.16), (0.20, 0.19, 0.18), 0.12),  # cheeks
    ((0.62, 1.13, 0.00), (0.17, 0.15, 0.16), 0.10),  # snout
    ((0.71, 1.095, 0.06), (0.09, 0.08, 0.08), 0.04),  # lips
    ((0.785, 1.19, 0.00), (0.045, 0.04, 0.06), 0.03),  # nose
]
EYE, SOCKET = (0.510, 1.319, 0.219), (0.575, 1.348, 0.300)
# centre, radii along the ear, across and through it, the way it points, the way it opens
EARS = [
    ((0.16, 1.87, 0.21), (0.49, 0.155, 0.075), (-0.16, 1.0, 0.22), (1.0, 0.2, 0.35)),
    ((0.20, 1.70, -0.23), (0.32, 0.15, 0.075), (-0.05, 1.0, -0.30), (1.0, 0.1, -0.30)),
    ((0.36, 1.89, -0.38), (0.27, 0.15, 0.070), (0.85, -0.25, -0.40), (0.25, -1.0, -0.2)),  # folded
]


def ellipsoid(x, y, z, centre, radii):
    """About the signed distance to an ellipsoid: exact in its zero set, near it to first order."""
    x, y, z = x - centre[0], y - centre[1], z - centre[2]
    a, b, c = x / radii[0], y / radii[1], z / radii[2]
    near = np.sqrt(a * a + b * b + c * c)
    a, b, c = a / radii[0], b / radii[1], c / radii[2]
    return near * (near - 1.0) / (np.sqrt(a * a + b * b + c * c) + 1e-9)


def union(a, b, softness):
    """The lesser of two distances, with the seam rounded."""
    if softness == 0.0:
        return np.minimum(a, b)
    h = np.maximum(softness - np.abs(a - b), 0.0)
    return np.minimum(a, b) - h * h / (4.0 * softness)


def carve(a, b, softness):
    """Take the second shape out of the first."""
    return -union(-a, b, softness)


def ear(x, y, z, centre, radii, along, front):
    """A flat ellipsoid, its front hollowed."""
    u = unit(np.array(along))
    w = unit(np.array(front) - u * (u[0] * front[0] + u[1] * front[1] + u[2] * front[2]))
    v = np.array([w[i - 2] * u[i - 1] - w[i - 1] * u[i - 2] for i in range(3)])
    x, y, z = x - centre[0], y - centre[1], z - centre[2]
    x, y, z = (x * axis[0] + y * axis[1] + z * axis[2] for axis in (u, v, w))
    hollow = (0.80 * radii[0], 0.66 * radii[1], 0.80 * radii[2])
    shell = ellipsoid(x, y, z, (0.0, 0.0, 0.0), radii)
    return carve(shell, ellipsoid(x, y, z, (0.0, 0.0, 0.95 * radii[2]), hollow), 0.03)


def unit(v):
    return v / np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


def rabbit(points):
    """About the signed distance to the rabbit: negative inside."""
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    d = np.full(len(points), 9.0)
    for centre, radii, softness in PARTS:
        d = union(d, ellipsoid(x, y, z, centre, radii), softness)
        if centre[2]:
            d = union(d, ellipsoid(x, y, -z, centre, radii), softness)
    whole, folded, tip = (ear(x, y, z, *row) for row in EARS)
    d = union(d, whole, 0.06)
    d = union(d, union(folded, tip, 0.05), 0.06)
    for side in (z, -z):
        d = carve(d, ellipsoid(x, y, side, SOCKET, (0.120, 0.120, 0.120)), 0.04)
        d = union(d, ellipsoid(x, y, side, EYE, (0.088, 0.094, 0.088)), 0.02)
    return carve(d, y - 0.02, 0.05)  # the ground


def sample(cells):
    """Return the field on a lattice of `cells` along y, exact where the surface is near.

    Elsewhere the value at the middle of a block stands for all its points: the sign is right.
    """
    step = (HIGH[1] - LOW[1]) / cells
    blocks = np.ceil((HIGH - LOW) / (step * BLOCK)).astype(int)
    middles = np.indices(blocks).reshape(3, -1).T * BLOCK + (BLOCK - 1) / 2
    coarse = rabbit(LOW + step * middles).reshape(blocks)
    for axis in range(3):
        coarse = np.repeat(coarse, BLOCK, axis)
    near = np.nonzero(np.abs(coarse) < 1.5 * BLOCK * step)
    coarse[near] = rabbit(LOW + step * np.stack(near, axis=1))
    return coarse, step


def repair(field):
    """Fill every cell where two sheets of the surface meet, or nearly so: then the net is manifold.

    One sheet alone crosses a cell if its corners inside hang together along its edges, and so do
    those outside.
    """
    bits = range(8)
    meeting = np.array(
        [
            not all(hang_together({b for b in bits if code >> b & 1 == side}) for side in (0, 1))
            for code in range(256)
        ]
    )
    flat = field.ravel()
    x, y, z = (stride // field.itemsize for stride in field.strides)
    offsets = [(b & 1) * x + (b >> 1 & 1) * y + (b >> 2) * z for b in bits]
    last = flat.size - offsets[-1]
    while True:
        codes = np.zeros(last, np.uint8)
        for b in bits:
            codes |= (flat[offsets[b] : offsets[b] + last] < 0.0).astype(np.uint8) << b
        cells = np.flatnonzero(meeting[codes])
        if not len(cells):
            return flat.reshape(field.shape)
        for offset in offsets:
            flat[cells + offset] = np.minimum(flat[cells + offset], -1e-3)


def hang_together(corners):
    """Return whether corners of a cube, as 3-bit numbers, are connected along its edges."""
    reached = set(sorted(corners)[:1])
    for _ in corners:
        reached |= {c for c in corners if {c ^ 1, c ^ 2, c ^ 4} & reached}
    return reached == corners


def surface_nets(field, step):
    """A vertex in each cell that the surface crosses, a quad across each edge: (V, 3), (Q, 4)."""
    flat = field.ravel()  # the outermost layers are outside: no edge from row to row is crossed
    strides = [field.shape[1] * field.shape[2], field.shape[2], 1]
    quads, crossings = [], []
    for axis in range(3):
        stride, u, v = (strides[axis - turn] for turn in (0, 2, 1))
        edges = np.flatnonzero((flat[:-stride] < 0.0) != (flat[stride:] < 0.0))
        a, b = flat[edges], flat[edges + stride]
        points = np.stack(np.unravel_index(edges, field.shape), axis=1).astype(float)
        points[:, axis] += a / (a - b)
        around = edges[:, None] - np.array([u + v, v, 0, u])
        quads.append(np.where((a < 0.0)[:, None], around, around[:, ::-1]))
        crossings.append(np.repeat(points, 4, axis=0))
    cells, quads = np.unique(np.concatenate(quads), return_inverse=True)
    points = average(quads.ravel(), np.concatenate(crossings), len(cells))
    return LOW + step * points, quads.reshape(-1, 4)


def average(groups, points, count):
    """The mean of the points of each group, added in their order."""
    sums = [np.bincount(groups, points[:, axis], count) for axis in range(3)]
    return np.stack(sums, axis=1) / np.bincount(groups, minlength=count)[:, None]


def relax(vertices, quads, step, rounds=4):
    """Slide every vertex to the middle of its neighbours, then back to the surface."""
    ends = np.concatenate([quads, np.roll(quads, 1, axis=1)]).ravel()
    others = np.concatenate([np.roll(quads, 1, axis=1), quads]).ravel()
    corners = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) * (0.1 * step)
    for _ in range(rounds):
        vertices = 0.4 * vertices + 0.6 * average(ends, vertices[others], len(vertices))
        a, b, c, d = (rabbit(vertices + corner) for corner in corners)
        slope = np.stack([a + b - c - d, a - b + c - d, a - b - c + d], axis=1)
        x, y, z = slope.T
        far = 0.1 * step * (a + b + c + d) / (x * x + y * y + z * z)
        vertices = vertices - far[:, None] * slope
    return vertices


def split(vertices, quads):
    """Each quad as two triangles, cut along its shorter diagonal: (T, 3)."""
    x, y, z = (vertices[quads[:, [2, 3]]] - vertices[quads[:, [0, 1]]]).T
    length = x * x + y * y + z * z
    turned = np.where((length[0] <= length[1])[:, None], quads, np.roll(quads, -1, axis=1))
    return turned[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def make_bunny(triangles=70_000):
    """Return vertices (V, 3), rounded to six decimals, and about `triangles` triangles (T, 3)."""
    cells = 72
    _, quads = surface_nets(*sample(cells))
    cells = round(cells * float(np.sqrt(triangles / (2 * len(quads)))))
    field, step = sample(cells)
    vertices, quads = surface_nets(repair(field), step)
    vertices = np.round(relax(vertices, quads, step), 6)
    return vertices, split(vertices, quads)


def main():
    parser = argparse.ArgumentParser(description="Make an example mesh: a rabbit, sitting.")
    parser.add_argument("-o", "--output", type=Path, default=Path("bunny.obj"))
    parser.add_argument("--triangles", type=int, default=70_000, help="about how many (70000)")
    arguments = parser.parse_args()
    if not 2_000 <= arguments.triangles <= 2_000_000:
        parser.error(f"--triangles {arguments.triangles}: choose from 2000 to 2000000")
    vertices, faces = make_bunny(arguments.triangles)
    lines = ["# a rabbit, made by examples/make_bunny.py of voxtool"]
    lines += ["v {:.6f} {:.6f} {:.6f}".format(*v) for v in vertices.tolist()]
    lines += ["f {} {} {}".format(*f) for f in (faces + 1).tolist()]
    arguments.output.write_text("\n".join(lines) + "\n", encoding="ascii", newline="\n")
    print(f"{arguments.output}: {len(vertices):,} vertices, {len(faces):,} triangles")


if __name__ == "__main__":
    main()
