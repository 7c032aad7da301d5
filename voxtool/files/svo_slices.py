"""Octrees in HDF5 whose attributes stay in the file, too (svo_hdf5.py): to describe and check them.

Whatever needs an octree's attributes otherwise has them in memory.
"""

from __future__ import annotations

from dataclasses import replace

from voxtool.files import svo_hdf5

SCHEMA = replace(
    svo_hdf5.SCHEMA, newer=(svo_hdf5.MERGED, replace(svo_hdf5.ATTRIBUTED, sliced=True))
)
