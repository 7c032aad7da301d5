"""voxtool: triangle meshes to exact sparse voxel octrees and distance fields, and pictures of these
and of tetrahedral volumes, with OpenCL, on CPU or GPU.

The public API: `__init__.pyi` lists its names for type checkers, and for this module, which imports
each of them when it is first used, so that a command starts fast.

>>> octree = voxtool.voxelize("bunny.obj", dim=512)
>>> octree.count, octree.digest()
>>> surface = voxtool.extract(octree)
>>> picture = voxtool.render(octree, "front")
"""

from __future__ import annotations

from importlib import import_module

from voxtool.version import __version__ as __version__

with open(__file__ + "i", encoding="utf-8") as _stub:  # from module import name as name
    _MODULES = {line.split()[-1]: line.split()[1] for line in _stub if line.startswith("from ")}

__all__ = sorted(_MODULES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'voxtool' has no attribute {name!r}")
    import_module("voxtool.api.pictures")  # gives the data classes their pictures in notebooks
    globals()[name] = value = getattr(import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return __all__
