"""Make an example model: a lighthouse of five parts, with two textures and colours of vertices.

    python examples/make_parts.py [-o parts.glb]

The name's ending decides: .glb holds everything; .obj gets a library of materials, .mtl, and two
pictures, .png, beside it. Each part is closed, and turned around the axis y, which is up; the model
is 4 high. The island has a chequered texture that repeats, the tower a striped one that is
mirrored and takes the nearest texel, the lamp a colour at each vertex, the balcony and the roof a
colour each.

Only + - * / and the square root decide where a vertex lies, and the pictures are stored without
packing, so every machine writes the same files.
"""

import argparse
import json
import struct
import zlib
from itertools import pairwise
from pathlib import Path

import numpy as np

TURN = 48  # corners of each circle
SIDE = 32  # pixels of each picture
# name, material, radius and height from bottom to top, how often the texture is laid around
PARTS = [
    ("island", "grass", [(0, 0), (1.5, 0), (1.75, 0.2), (1.5, 0.45), (0, 0.5)], 6),
    ("tower", "stripes", [(0, 0.4), (0.62, 0.4), (0.56, 1.0), (0.42, 2.6), (0, 2.6)], 2),
    ("balcony", "iron", [(0, 2.58), (0.5, 2.58), (0.62, 2.75), (0.55, 2.85), (0, 2.85)], 1),
    ("lamp", "light", [(0, 2.8), (0.3, 2.8), (0.36, 3.05), (0.3, 3.3), (0, 3.3)], 1),
    ("roof", "copper", [(0, 3.25), (0.5, 3.25), (0.2, 3.7), (0.06, 4.0), (0, 4.0)], 1),
]
COLOURS = {  # in linear light
    "grass": (1.0, 1.0, 1.0),
    "stripes": (1.0, 1.0, 1.0),
    "iron": (0.05, 0.06, 0.08),
    "light": (1.0, 1.0, 1.0),
    "copper": (0.6, 0.07, 0.04),
}


def circle(count):
    """Points around the unit circle, a power of two times three of them, from +x towards -z."""
    found = [(1.0, 0.0), (-0.5, 0.75**0.5), (-0.5, -(0.75**0.5))]
    while len(found) < count:  # between each two, the point in their middle
        between = []
        for (a, b), (c, d) in pairwise([*found, found[0]]):
            x, y = a + c, b + d
            r = (x * x + y * y) ** 0.5
            between += [(a, b), (x / r, y / r)]
        found = between
    return found


def turned(profile, repeats):
    """Vertices, texture coordinates (v down) and triangles of a profile turned around y."""
    around = [*circle(TURN), (1.0, 0.0)]  # the seam has its vertices twice
    low, high = profile[0][1], profile[-1][1]
    vertices, uv, faces = [], [], []
    for r, y in profile:
        for i, (c, s) in enumerate(around):
            vertices.append((r * c, y, -r * s))
            uv.append((repeats * i / TURN, 2.0 * (high - y) / (high - low)))
    row = TURN + 1
    for ring, (below, above) in enumerate(pairwise(profile)):
        for i in range(TURN):
            a = ring * row + i
            if below[0] > 0:
                faces.append((a, a + 1, a + row + 1))
            if above[0] > 0:
                faces.append((a, a + row + 1, a + row))
    if repeats == 6:  # the island: as seen from above
        uv = [(x + 2.0, z + 2.0) for x, _, z in vertices]
    return np.array(vertices), np.array(uv), np.array(faces)


def pictures():
    """The pixels of the two textures, (SIDE, SIDE, 3)."""
    i, j = np.mgrid[:SIDE, :SIDE]
    light = ((i // 8 + j // 8) % 2 == 0)[..., None]
    grass = np.where(light, (96, 160, 64), (48, 112, 40)) + (i * 7 + j * 13)[..., None] % 9
    stripes = np.where((i < SIDE // 2)[..., None], (208, 32, 40), (244, 240, 228))
    return {"grass": grass.astype(np.uint8), "stripes": stripes.astype(np.uint8) + 0 * j[..., None]}


def png(pixels):
    """A PNG of RGB pixels, whose data is stored as it is."""

    def chunk(kind, data):
        check = zlib.crc32(kind + data)
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", check)

    height, width, _ = pixels.shape
    rows = b"".join(b"\0" + row.tobytes() for row in pixels.astype(np.uint8))
    stored = b"\x78\x01"
    for start in range(0, len(rows), 65535):
        part = rows[start : start + 65535]
        last = start + 65535 >= len(rows)
        stored += struct.pack("<BHH", last, len(part), len(part) ^ 0xFFFF) + part
    stored += struct.pack(">I", zlib.adler32(rows))
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", stored) + chunk(b"IEND", b"")
    )


def lamp_colours(vertices):
    """The lamp's colours in linear light: from yellow below to orange above."""
    share = ((vertices[:, 1] - vertices[:, 1].min()) / np.ptp(vertices[:, 1]))[:, None]
    return (1 - share) * (1.0, 0.8, 0.1) + share * (1.0, 0.25, 0.02)


def glb():
    """The bytes of the model as a GLB: nodes under one that lifts them, two textures."""
    data, views, accessors = b"", [], []

    def held(content):
        nonlocal data
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(content)})
        data += content + bytes(-len(content) % 4)
        return len(views) - 1

    def accessor(array, kind, code):
        found = {"bufferView": held(array.tobytes()), "componentType": code, "count": len(array)}
        if kind == "VEC3":
            found |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        accessors.append({**found, "type": kind})
        return len(accessors) - 1

    meshes, nodes, materials = [], [], []
    shown = ["grass", "stripes"]
    for index, (name, material, profile, repeats) in enumerate(PARTS):
        vertices, uv, faces = turned(profile, repeats)
        middle = np.array((0.0, profile[0][1], 0.0))  # each node is placed by its own transform
        attributes = {"POSITION": accessor((vertices - middle).astype("<f4"), "VEC3", 5126)}
        if material in shown:
            attributes["TEXCOORD_0"] = accessor(uv.astype("<f4"), "VEC2", 5126)
        if material == "light":
            attributes["COLOR_0"] = accessor(lamp_colours(vertices).astype("<f4"), "VEC3", 5126)
        corners = accessor(faces.astype("<u2").ravel(), "SCALAR", 5123)
        primitive = {"attributes": attributes, "indices": corners, "material": index}
        meshes.append({"name": name, "primitives": [primitive]})
        nodes.append({"name": name, "mesh": index, "translation": middle.tolist()})
        texture = (
            {"baseColorTexture": {"index": shown.index(material)}} if material in shown else {}
        )
        described = {"baseColorFactor": [*COLOURS[material], 1.0], **texture}
        materials.append({"name": material, "pbrMetallicRoughness": described})
    images = [
        {"name": name, "mimeType": "image/png", "bufferView": held(png(pixels))}
        for name, pixels in pictures().items()
    ]
    nodes.append({"name": "lighthouse", "children": list(range(len(PARTS)))})
    tree = {
        "asset": {"version": "2.0", "generator": "voxtool examples/make_parts.py"},
        "scene": 0,
        "scenes": [{"nodes": [len(PARTS)]}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": materials,
        "textures": [{"source": 0, "sampler": 0}, {"source": 1, "sampler": 1}],
        "samplers": [{"wrapS": 10497, "wrapT": 10497, "magFilter": 9729},
                     {"wrapS": 33648, "wrapT": 33648, "magFilter": 9728}],
        "images": images,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }  # fmt: skip
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(data)
    head = struct.pack("<4sII", b"glTF", 2, size)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    return head + chunks + struct.pack("<I4s", len(data), b"BIN\0") + data


def srgb(linear):
    """About the sRGB of linear light, for the library of materials: a root, by halves."""
    return round(linear**0.5, 3)


def write_obj(path):
    """Write the model as an OBJ, its library of materials and two pictures."""
    lines, library, known = [f"mtllib {path.stem}.mtl"], [], 0
    for name, material, profile, repeats in PARTS:
        vertices, uv, faces = turned(profile, repeats)
        lines += [f"o {name}", f"usemtl {material}"]
        lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices]
        lines += [f"vt {u:.6f} {1 - v:.6f}" for u, v in uv]
        corners = faces + known + 1
        lines += ["f " + " ".join(f"{c}/{c}" for c in face) for face in corners]
        known += len(vertices)
        colour = " ".join(str(srgb(c)) for c in COLOURS[material])
        library += [f"newmtl {material}", f"Kd {colour if material != 'light' else '1 0.8 0.3'}"]
        if material in pictures():
            library.append(f"map_Kd {path.stem}_{material}.png")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    path.with_suffix(".mtl").write_text("\n".join(library) + "\n", encoding="utf-8")
    for material, pixels in pictures().items():
        path.with_name(f"{path.stem}_{material}.png").write_bytes(png(pixels))


def main():
    parser = argparse.ArgumentParser(description="Make an example model of five parts.")
    parser.add_argument("-o", "--output", type=Path, default=Path("parts.glb"))
    path = parser.parse_args().output
    if path.suffix == ".obj":
        write_obj(path)
    else:
        path.write_bytes(glb())


if __name__ == "__main__":
    main()
