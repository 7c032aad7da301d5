"""Results that are computed once for a mesh, and kept as long as the mesh."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

from voxtool.mesh.mesh import Mesh

More = ParamSpec("More")
Found = TypeVar("Found")
_found: dict[tuple[int, Callable[..., Any]], Any] = {}


def once(
    find: Callable[Concatenate[Mesh, More], Found],
) -> Callable[Concatenate[Mesh, More], Found]:
    """Return `find` with its first result for each mesh kept. Arguments
    after the mesh may change how it is found, as a device does, but not the result."""

    @wraps(find)
    def kept(mesh: Mesh, *args: More.args, **options: More.kwargs) -> Found:
        key = id(mesh), find
        if key not in _found:
            _found[key] = find(mesh, *args, **options)
            weakref.finalize(mesh, _found.pop, key, None)
        return _found[key]

    return kept
