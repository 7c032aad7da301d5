"""The materials, textures and colours of a glTF."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import MeshError
from voxtool.files.meshes.pixels import Pictures
from voxtool.mesh.appearance import Material, Texture

if TYPE_CHECKING:
    from voxtool.files.meshes.gltf import Tree

WRAPS = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
NEAREST = 9728  # of magFilter; all others are linear
TRANSFORM = "KHR_texture_transform"


class Looks:
    """The materials of a glTF that its meshes use, each read when it is first met."""

    def __init__(self, tree: Tree, max_memory: int | None) -> None:
        self.tree, self.pictures = tree, Pictures(max_memory)
        self.materials: list[Material] = []
        self.numbers: dict[tuple[int, bool], int] = {}
        self.textures: dict[tuple[int, bool, tuple[str, str], bool], Texture] = {}

    def of(
        self, primitive: dict[str, Any], corners: np.ndarray, points: int
    ) -> tuple[int, np.ndarray | None, np.ndarray | None]:
        """Return the number of a primitive's material, or -1, the texture coordinates (F, 3, 2) of
        its triangles, and the colours (V, 4) of its vertices, or None."""
        index = primitive.get("material", -1)
        described = self.tree.json["materials"][index] if index >= 0 else {}
        base = described.get("pbrMetallicRoughness", {})
        opaque = described.get("alphaMode", "OPAQUE") == "OPAQUE"
        uv = self._uv(primitive, base.get("baseColorTexture"), corners, points)
        number = -1
        if index >= 0:
            number = self._number(index, described, base, opaque, uv is not None)
        return number, uv, self._colours(primitive, opaque, points)

    def _uv(
        self,
        primitive: dict[str, Any],
        texture: dict[str, Any] | None,
        corners: np.ndarray,
        points: int,
    ) -> np.ndarray | None:
        if texture is None:
            return None
        moved = texture.get("extensions", {}).get(TRANSFORM, {})
        if moved.get("rotation"):
            raise MeshError(f"{self.tree.name}: a texture is rotated by {TRANSFORM}: bake it")
        which = moved.get("texCoord", texture.get("texCoord", 0))
        accessor = primitive["attributes"].get(f"TEXCOORD_{which}")
        if accessor is None:
            return None
        rows = self._rows(accessor, points, (2,))
        with np.errstate(all="ignore"):  # what is not finite is refused later
            rows = rows * np.array(moved.get("scale", (1, 1)), np.float64)
            rows = rows + np.array(moved.get("offset", (0, 0)), np.float64)
        return rows[np.clip(corners, 0, max(points - 1, 0))]  # corners are checked later

    def _colours(self, primitive: dict[str, Any], opaque: bool, points: int) -> np.ndarray | None:
        accessor = primitive["attributes"].get("COLOR_0")
        if accessor is None:
            return None
        found = self._rows(accessor, points, (3, 4))
        result = np.ones((points, 4))
        result[:, : 3 if opaque else found.shape[1]] = found[:, : 3 if opaque else None]
        return result

    def _rows(self, accessor: int, points: int, columns: tuple[int, ...]) -> np.ndarray:
        rows = self.tree.numbers(accessor)
        if rows.shape[1] not in columns or len(rows) != points:
            raise ValueError(f"accessor {accessor} does not fit {points} vertices")
        return rows

    def _number(
        self, index: int, described: dict[str, Any], base: dict[str, Any], opaque: bool, has: bool
    ) -> int:
        """Return the number of a material, with its texture if `has` coordinates of it."""
        key = index, has
        if key not in self.numbers:
            factor = [float(one) for one in base.get("baseColorFactor", (1, 1, 1, 1))]
            red, green, blue, alpha = factor
            colour = red, green, blue, 1.0 if opaque else alpha
            texture = self._texture(base["baseColorTexture"]["index"], opaque) if has else None
            name = str(described.get("name", f"material {index}"))
            self.numbers[key] = len(self.materials)
            self.materials.append(Material(name, colour, texture))
        return self.numbers[key]

    def _texture(self, index: int, opaque: bool) -> Texture:
        """Return a texture; those that show an image in the same way are one."""
        described = self.tree.json["textures"][index]
        if "source" not in described:
            raise MeshError(
                f"{self.tree.name}: texture {index} is no PNG or JPEG: export it with these"
            )
        sampler = {}
        if "sampler" in described:
            sampler = self.tree.json["samplers"][described["sampler"]]
        wraps = WRAPS[sampler.get("wrapS", 10497)], WRAPS[sampler.get("wrapT", 10497)]
        nearest = sampler.get("magFilter") == NEAREST
        key = described["source"], opaque, wraps, nearest
        if key not in self.textures:
            pixels = self._read(described["source"])
            if opaque and (pixels[..., 3] != 255).any():
                pixels = pixels.copy()
                pixels[..., 3] = 255
            self.textures[key] = Texture(pixels, wraps, "nearest" if nearest else "linear")
        return self.textures[key]

    def _read(self, index: int) -> np.ndarray:
        """Return the pixels of an image."""
        described = self.tree.json["images"][index]
        label = f"texture {str(described.get('name') or index)[:40]!r}"
        if "bufferView" in described:
            data = self.tree.view(described["bufferView"])
        else:
            data = self.tree.companions.read(described["uri"], "texture", quoted=True)
        return self.pictures.read(f"{self.tree.name}: {label}", data)
