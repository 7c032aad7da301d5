"""The golden digests of exports and imports, of octrees and of fields; run as a
script, this writes them anew.

A format whose bytes are all of voxtool's making has the digest of its bytes, pictures that of their
pixels, and every other format that of its grid and values, as its reader here returns them: what
other libraries pack may change. Digests change only together with a line in CHANGELOG.md that says
why:
    make golden KIND=exchange
"""

from __future__ import annotations

import hashlib
import json
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import voxtool
from golden import svo as golden_svo
from voxtool.choices import FLUIDS, LATTICES
from voxtool.files.formats import EXCHANGE, EXPORTS, IMAGES, ending, folder_of
from voxtool.files.grids.voxels import Boxes, Stored
from voxtool.files.imports import Source

GOLDEN = Path(__file__).parent / "exchange.json"
OWN = {"sphere": "solid", "needles": "surface26"}  # modes
DIM = 24
OWN_BYTES = ("npy", "vti", "binvox", "vox", "nvdb", "ply", "xyz", "vtu", "msh", "inp")


def digest(*parts: bytes | np.ndarray) -> str:
    """Return the SHA-256 of bytes and arrays."""
    sha = hashlib.sha256()
    for part in parts:
        sha.update(part if isinstance(part, bytes) else np.ascontiguousarray(part).data)
    return sha.hexdigest()


def digest_of(stored: Stored) -> str:
    """Return the SHA-256 of the grid, the axes and the values that a reader returns."""
    grid, axes, flips = stored.frame
    values = np.zeros(stored.frame.shape)
    for piece in stored.pieces:
        boxes = isinstance(piece, Boxes)
        sides = piece.values.shape[1:] if boxes else (piece.side,) * 3
        for i, low in enumerate(np.asarray(piece.corners)):
            # a block may reach beyond the grid
            part = values[tuple(slice(n, n + side) for n, side in zip(low, sides, strict=True))]
            whole = np.broadcast_to(piece.values[i], sides)
            part[...] = whole[tuple(map(slice, part.shape))]
    place = np.array([grid.origin, grid.pitch], "<f8")
    return digest(place, repr((grid.shape, axes, flips)).encode(), values.astype("<f8"))


def digest_of_pictures(path: Path) -> str:
    """Return the SHA-256 of the pixels of a picture, or of all pictures in a folder."""
    from PIL import Image

    paths = sorted(path.glob("*.png")) if path.is_dir() else [path]
    return digest(*(np.asarray(Image.open(each).convert("RGBA")) for each in paths))


def digests(own: str, device: Any) -> Iterator[tuple[str, str]]:
    """Yield the digests of every export of the octree of a mesh, of voxels and of cells of two, and
    of the octree that each becomes again; then those of the mesh's field."""
    mesh = golden_svo.own_mesh(own)
    grid = voxtool.Grid.fit(mesh, DIM)
    octree = voxtool.voxelize(mesh, grid, OWN[own], fill="parity", device=device)
    for name in EXPORTS:
        for level in (0, 1) if EXCHANGE[name].parts else (0,):
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder, "layers" if "%" in name else "", f"a{ending(name)}")
                voxtool.export(octree, path, level=level)
                label = f"{name} level {level}"
                if name in OWN_BYTES:
                    yield label, digest(path.read_bytes())
                elif not EXCHANGE[name].reads:
                    yield label, digest_of_pictures(folder_of(path, name))
                else:
                    with Source.of(path, name).stored() as stored:
                        yield label, digest_of(stored)
                if EXCHANGE[name].reads:
                    yield f"{label} imported", voxtool.read_voxels(path).digest()
    for name in (name for name, format in EXCHANGE.items() if format.hexahedra):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, f"a.{name}")
            voxtool.export(octree, path, leaves=True)
            yield f"{name} leaves", digest(path.read_bytes())
    warnings.simplefilter("ignore", voxtool.MeshWarning)  # a mesh of needles has no inside
    for lattice in LATTICES:
        for fluid in FLUIDS:
            links = voxtool.wall_links(octree, mesh, lattice, fluid, device=device)
            yield f"links {lattice} {fluid}", links.digest()
    yield from digests_of_field(voxtool.build_adf(mesh, max_level=5, device=device), device)


def digests_of_field(field: voxtool.DistanceField, device: Any) -> Iterator[tuple[str, str]]:
    """Yield the digests of every export of a field: of its bytes, or of what is read of it; and of
    the field that it becomes again."""
    for name, format in EXCHANGE.items():
        if format.dense or format.levels:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder, f"a{ending(name)}")
                spacing = field.side / 20.3
                voxtool.export(field, path, spacing=spacing, device=device)
                if name in OWN_BYTES:
                    yield f"field {name}", digest(path.read_bytes())
                else:
                    with Source.of(path, name).stored() as stored:
                        yield f"field {name}", digest_of(stored)
                if name in IMAGES:
                    found = voxtool.read_field(path, tolerance=1e-3, device=device)
                    yield f"field {name} imported", found.digest()


def main() -> None:
    device = voxtool.open_device()
    golden = {name: dict(digests(name, device)) for name in OWN}
    GOLDEN.write_text(json.dumps(golden, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
