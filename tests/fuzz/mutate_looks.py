"""Mutants of pictures, and of words of an OBJ and its library; and of any bytes."""

from __future__ import annotations

import random
import re
import struct
import zlib

SECRET = "../../secret.txt"  # a file that no reader may open, from the folder of a case
STATEMENTS = "newmtl usemtl mtllib map_Kd Kd d Tr o g v vt f -s -o -clamp on -bm -mm 1/1 -1"
WORDS = (*str.split(STATEMENTS), SECRET, "a.obj", "a_grass.png", "\xff", "")
CHUNKS = (b"IHDR", b"IDAT", b"PLTE", b"tRNS", b"gAMA", b"iCCP", b"tEXt", b"acTL", b"fdAT", b"XXXX")
SIZES = (0, 1, 7, 9, 65535, 2**31 - 1)  # of a picture's side


def change_bytes(data: bytes, rng: random.Random) -> bytes:
    """Bytes flipped, overwritten, inserted, removed, repeated, or the end missing."""
    changed = bytearray(data)
    place, size = rng.randrange(len(data) + 1), rng.choice((1, 1, 2, 4, 8, 64, 512))
    match rng.randrange(7):
        case 0 if changed:
            changed[place % len(changed)] ^= 1 << rng.randrange(8)
        case 1:
            changed[place : place + size] = (
                bytes([rng.choice((0, 1, 9, 10, 32, 45, 127, 255))]) * size
            )
        case 2:
            changed[place:place] = rng.randbytes(size)
        case 3:
            del changed[place : place + size]
        case 4:
            changed[place:place] = changed[place : place + size] * rng.choice((1, 2, 100))
        case 5:
            del changed[place:]
        case _:
            other = rng.randrange(len(data) + 1)
            changed[place : place + size] = changed[other : other + size]
    return bytes(changed)


def change_words(data: bytes, rng: random.Random) -> bytes:
    """A word of an OBJ or its library replaced by another one, or by an option of map_Kd."""
    words = list(re.finditer(rb"[^\s]+", data))
    if not words:
        return data
    at = rng.choice(words)
    other = rng.choice((*(word.encode() for word in WORDS), rng.choice(words)[0]))
    return data[: at.start()] + other + data[at.end() :]


def change_png(data: bytes, rng: random.Random) -> bytes:
    """A chunk of a PNG changed, dropped or repeated, with its check right; its pixels packed anew,
    fewer, or many more than its head says."""
    start = data.find(b"\x89PNG")
    end = data.find(b"IEND", start) + 8
    if start < 0 or end < 8:
        return change_bytes(data, rng)
    chunks, place = [], start + 8
    while place < end:
        (size,) = struct.unpack_from(">I", data, place)
        chunks.append((data[place + 4 : place + 8], data[place + 8 : place + 8 + size]))
        place += size + 12
    which = rng.randrange(len(chunks))
    kind, body = chunks[which]
    match rng.randrange(6):
        case 0:
            del chunks[which]
        case 1:
            chunks[which:which] = [chunks[which]] * rng.choice((1, 2, 100))
        case 2:
            chunks[which] = rng.choice(CHUNKS), body
        case 3:
            chunks[1] = b"IDAT", zlib.compress(bytes(rng.choice((0, 10, 1 << 24))))
        case 4:
            size = struct.pack(">II", rng.choice(SIZES), rng.choice(SIZES))
            head = bytes(rng.choice((0, 1, 2, 3, 4, 6, 8, 16)) for _ in range(2)) + bytes(3)
            chunks[0] = b"IHDR", (size if rng.random() < 0.5 else chunks[0][1][:8]) + head
        case _:
            chunks[which] = kind, change_bytes(body, rng)
    found = data[start : start + 8]
    for kind, body in chunks:
        check = struct.pack(">I", zlib.crc32(kind + body))
        found += struct.pack(">I", len(body)) + kind + body + check
    if start:  # inside of another file, where it keeps its size
        found = found[: end - start].ljust(end - start, b"\0")
    return data[:start] + found + data[end:]
