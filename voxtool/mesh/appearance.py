"""The parts, materials, textures and colours of the faces and vertices of a mesh.

Readers fill these on request alone: see `keep` of files.mesh.load_mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from voxtool.arrays import Data
from voxtool.choices import NAMED
from voxtool.errors import MeshError

FILE = "file"
GROUPINGS = (*NAMED, FILE)  # of faces
WRAPS = ("repeat", "mirror", "clamp")  # of textures beyond 0 to 1, as in glTF
FILTERS = ("linear", "nearest")
WHITE = (1.0, 1.0, 1.0, 1.0)
MOST_UV = 1 << 20  # repeats of a texture on either side of 0


@dataclass(frozen=True, eq=False)
class Parts(Data):
    """The part of each face.

    Attributes
    ----------
    labels : (F,) int32
        Index of the part's name.
    names : tuple of str
        Names of the parts, in the order of the file; they may repeat.
    """

    labels: np.ndarray
    names: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Texture(Data):
    """An image on a surface.

    Attributes
    ----------
    pixels : (H, W, 4) uint8
        Red, green, blue in sRGB, and opacity; row 0 is the top, v = 0.
    wrap : (2,) tuple of str
        One of WRAPS along u and along v.
    filter : str
        One of FILTERS.
    """

    pixels: np.ndarray
    wrap: tuple[str, str] = ("repeat", "repeat")
    filter: str = "linear"


@dataclass(frozen=True, eq=False)
class Material(Data):
    """A material.

    Attributes
    ----------
    name : str
    colour : (4,) tuple of float
        Red, green, blue and opacity from 0 to 1, in linear light; multiplies the texture.
    texture : Texture, optional
    """

    name: str
    colour: tuple[float, float, float, float] = WHITE
    texture: Texture | None = None


@dataclass(frozen=True, eq=False)
class Appearance(Data):
    """The materials, textures and colours of a mesh.

    Attributes
    ----------
    materials : tuple of Material
    material : (F,) int32
        Index of each face's material, or -1.
    uv : (F, 3, 2) float64, optional
        Texture coordinates u to the right and v down, from 0 to 1 over the image, of each corner.
    colours : (V, 4) float64, optional
        Red, green, blue and opacity of each vertex, in linear light; multiply the material's.
    """

    materials: tuple[Material, ...]
    material: np.ndarray
    uv: np.ndarray | None = None
    colours: np.ndarray | None = None


def check_described(
    name: str, vertices: int, faces: int, parts: dict[str, Parts], look: Appearance | None
) -> None:
    """Raise MeshError if parts or an appearance do not fit a mesh, by its vertices and faces."""
    where = name or "mesh"
    for what, grouping in parts.items():
        labels = grouping.labels
        if what not in GROUPINGS or labels.dtype != np.int32 or labels.shape != (faces,):
            raise MeshError(f"{where}: labels of {what!r} are not (F,) int32 of {faces} faces")
        if faces and not 0 <= labels.min() <= labels.max() < len(grouping.names):
            raise MeshError(f"{where}: a label of {what!r} has no name")
    if look is None:
        return
    shapes = {
        "material": (look.material, (faces,)),
        "uv": (look.uv, (faces, 3, 2)),
        "colours": (look.colours, (vertices, 4)),
    }
    for what, (array, shape) in shapes.items():
        if array is not None and array.shape != shape:
            raise MeshError(f"{where}: {what} of shape {array.shape}, not {shape}")
    if faces and not -1 <= look.material.min() <= look.material.max() < len(look.materials):
        raise MeshError(f"{where}: a face has a material that there is not")
    if look.uv is not None:
        _check_uv(where, look)
    if look.colours is not None and not ((look.colours >= 0) & (look.colours <= 1)).all():
        vertex = int(np.argmin(((look.colours >= 0) & (look.colours <= 1)).all(axis=1)))
        raise MeshError(f"{where}: the colour of vertex {vertex} is not from 0 to 1: correct it")


def _check_uv(where: str, look: Appearance) -> None:
    """Raise MeshError for texture coordinates of a texture that are not finite, or far out."""
    textured = np.array([one.texture is not None for one in look.materials] + [False])
    uv = look.uv[textured[look.material]] if look.uv is not None else np.empty((0, 3, 2))
    if (np.abs(uv) <= MOST_UV).all():
        return
    faces = np.flatnonzero(textured[look.material])
    face = faces[np.argmin((np.abs(uv) <= MOST_UV).all(axis=(1, 2)))]
    raise MeshError(
        f"{where}: a texture coordinate of face {face} is not finite, or beyond {MOST_UV}: unwrap "
        "the mesh again"
    )
