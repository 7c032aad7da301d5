"""The parts of VTK that read and write grids.

All of VTK is 400 libraries. A process keeps them in its list of mappings, which Intel's driver
reads for each program that it builds.
"""

from __future__ import annotations

import functools
import importlib
from types import SimpleNamespace

import pytest

PARTS = ("vtkCommonCore", "vtkCommonDataModel", "vtkIOHDF", "vtkIOXML", "vtkFiltersHyperTree",
         "vtkFiltersVerdict", "util.numpy_support")  # fmt: skip


@functools.cache
def vtk() -> SimpleNamespace:
    """Return the names in PARTS; without VTK, skip the test or the module that calls this."""
    pytest.importorskip("vtkmodules")
    parts = [vars(importlib.import_module(f"vtkmodules.{name}")) for name in PARTS]
    return SimpleNamespace(**{name: value for part in parts for name, value in part.items()})
