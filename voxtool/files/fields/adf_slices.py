"""Distance fields in HDF5 whose blocks stay in the file; see adf_hdf5.py."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from voxtool.adf.field.field import DistanceField
from voxtool.adf.field.packing import VERTICES
from voxtool.adf.field.spatial_hash import SpatialHash
from voxtool.adf.field.stored_field import StoredField
from voxtool.errors import FileError
from voxtool.files.fields import adf_hdf5
from voxtool.files.storage.schema import expect


def _build(values: dict[str, Any], arrays: dict[str, Any]) -> StoredField:
    sides = len(arrays["voxels"]), *arrays["voxels"][:1].shape[1:]
    if any(side % VERTICES or not side for side in sides):
        raise FileError(f"dataset voxels has shape {sides}: blocks of 3 x 3 x 3 fill it")
    z, y, x = (side // VERTICES for side in sides)
    table = SpatialHash(values["m"], values["r"], arrays["hash"][:])
    field = StoredField(
        arrays["voxels"], arrays.get("bounds"), (x, y, z), arrays["cells"][:], table,
        values["origin"], values["side"],
    )  # fmt: skip
    expect("depth", values["depth"], (field.depth,))
    return field


def _older(values: dict[str, Any], arrays: dict[str, Any]) -> DistanceField:
    return adf_hdf5.VERSION_1.build(values, {name: array[:] for name, array in arrays.items()})


SCHEMA = replace(
    adf_hdf5.SCHEMA,
    build=_build,
    sliced=True,
    older=(replace(adf_hdf5.VERSION_1, build=_older, sliced=True),),
)
