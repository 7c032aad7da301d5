"""The appearance of a mesh as arrays for kernels (kernels/svo/attribution/materials.h)."""

from __future__ import annotations

from typing import Any

import numpy as np

from voxtool.errors import MemoryLimitError, MeshError
from voxtool.mesh.appearance import WRAPS, Appearance, Texture
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.srgb import ONE, level_bounds, linear_table
from voxtool.opencl import Device, program

MOST_SIDE = 32  # texels along an axis that a part of a triangle may cover, to be integrated exactly
SLIVER = 1 << 24  # a part of several texels that covers less than 1/SLIVER of one is sampled
SAMPLES = 32  # along a side of each triangle of a part that covers more
LIGHT_ONE = ONE  # of linear light, in kernels
CLAMP, MIRROR = WRAPS.index("clamp"), WRAPS.index("mirror")
MOST_IN_ALL = (1 << 31) - 1  # texels: indices are int32


def _table(name: str, values: np.ndarray) -> str:
    """Return whole numbers as an OpenCL constant."""
    numbers = ", ".join(map(str, values.tolist()))
    return f"__constant const uint {name}[{len(values)}] = {{{numbers}}};"


HEADERS = {
    "svo/attribution/textures.h": "\n".join([
        program.c_constants(
            LIGHT_ONE=LIGHT_ONE, CLAMP=CLAMP, MIRROR=MIRROR, MOST_SIDE=MOST_SIDE,
            SAMPLES=SAMPLES, SLIVER=SLIVER,
        ),
        _table("LINEAR", linear_table()),
        _table("BOUNDS", level_bounds()),
    ])
}  # fmt: skip


def check_look(mesh: Mesh) -> Appearance:
    """Return the appearance of a mesh; MeshError if it has none."""
    if mesh.appearance is None:
        raise MeshError(
            f"{mesh.name or 'mesh'}: it has no colours, no materials and no textures: give a mesh "
            'that has (in Python, read with keep=("appearance",)), or leave out colour'
        )
    return mesh.appearance


def textures_of(look: Appearance) -> list[Texture]:
    """Return the textures of all materials, each once."""
    return list({id(one.texture): one.texture for one in look.materials if one.texture}.values())


def texels_of(look: Appearance) -> int:
    """Return the number of texels."""
    return sum(one.pixels.shape[0] * one.pixels.shape[1] for one in textures_of(look))


def look_bytes(mesh: Mesh) -> int:
    """Return the bytes that the appearance takes on a device."""
    look = check_look(mesh)
    arrays = (look.uv, look.colours, look.material)
    held = sum(array.nbytes for array in arrays if array is not None)
    return held + 4 * texels_of(look) + 40 * len(look.materials)


def look_arguments(mesh: Mesh, device: Device) -> dict[str, Any]:
    """Return the arguments LOOK of kernels, on the device."""
    look = check_look(mesh)
    textures = textures_of(look)
    if texels_of(look) > MOST_IN_ALL:
        raise MemoryLimitError(
            f"{mesh.name or 'mesh'}: {texels_of(look):,} texels, at most {MOST_IN_ALL:,} can be "
            "used: make the textures smaller"
        )
    number_of = {id(texture): number for number, texture in enumerate(textures)}
    rows, first = [], 0
    for texture in textures:
        height, width, _ = texture.pixels.shape
        wraps = map(WRAPS.index, texture.wrap)
        rows.append((first, width, height, *wraps, texture.filter == "nearest"))
        first += height * width
    colours = np.array([one.colour for one in look.materials], np.float64)
    numbers = [number_of.get(id(one.texture), -1) for one in look.materials]
    return {
        "material_of": device.put(np.asarray(look.material, np.int32)),
        "materials": _put(device, colours),
        "texture_of": _put(device, np.array(numbers, np.int32)),
        "textures": _put(device, np.array(rows, np.int32)),
        "texels": _put(device, [texture.pixels for texture in textures]),
        "uv": None if look.uv is None else device.put(look.uv),
        "colours": None if look.colours is None else device.put(look.colours),
    }


LOOK = ("material_of", "materials", "texture_of", "textures", "texels", "uv", "colours")
NO_LOOK: dict[str, Any] = dict.fromkeys(LOOK)


def _put(device: Device, values: Any) -> Any:
    """Return values on the device, in a row; None for none."""
    if isinstance(values, list):
        values = np.concatenate([one.ravel() for one in values]) if values else np.empty(0)
    return device.put(values.ravel()) if values.size else None
