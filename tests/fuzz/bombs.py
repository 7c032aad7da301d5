"""Small files that unpack to, or declare, much more."""

from __future__ import annotations

import base64
import struct
import zlib
from pathlib import Path

import h5py

DATA = Path(__file__).parents[1] / "data"


def vtu_bomb(block: int = 1 << 24, blocks: int = 10) -> bytes:
    """A .vtu of 0.2 MB whose one array takes 160 MB, and whose points take 24 bytes."""
    packed = zlib.compress(bytes(block), 9)
    head = struct.pack(f"<{3 + blocks}I", blocks, block, block, *[len(packed)] * blocks)
    array = base64.b64encode(head) + base64.b64encode(packed * blocks)
    opening = (
        b'<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian" '
        b'header_type="UInt32" compressor="vtkZLibDataCompressor"><UnstructuredGrid>'
        b'<Piece NumberOfPoints="1" NumberOfCells="0"><PointData>'
        b'<DataArray type="Float32" Name="s" format="binary">'
    )
    return opening + array + b"</DataArray></PointData></Piece></UnstructuredGrid></VTKFile>"


def write_exodus_bomb(path: Path, count: int = 10**8, chunk: bytes = b"") -> None:
    """Write an Exodus file of `count` points, without data, or with one chunk that unpacks to
    more."""
    import netCDF4

    with netCDF4.Dataset(path, "w") as file:
        file.createDimension("num_nodes", count)
        for axis in "xyz":
            file.createVariable(f"coord{axis}", "f8", ("num_nodes",), zlib=True)
    if chunk:
        with h5py.File(path, "r+") as file:
            file["coordx"].id.write_direct_chunk((0,), chunk)


def endless_list(name: str) -> bytes:
    """A file of tests/data in whose heap of names the list of free places leads back to itself:
    HDF5 takes memory for each of them."""
    data = bytearray((DATA / name).read_bytes())
    first, place = struct.unpack_from("<QQ", data, data.index(b"HEAP") + 16)
    struct.pack_into("<Q", data, place + first, first)
    return bytes(data)
