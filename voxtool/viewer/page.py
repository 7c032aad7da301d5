"""Putting a page together: template, style, scripts, shaders and data in one file.

Data are blocks of base64, JSON has no `<`, and text is escaped, so that nothing of a file is markup
or script. A content security policy names the script and the style by their digests and lets the
page reach nothing else.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import html
import json
import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import human, printable
from voxtool.opencl.program import kernel_folder

if TYPE_CHECKING:
    from voxtool.viewer.content import PageContent

ASSETS = Path(__file__).parent / "assets"
SHARED = ("vectors", "data", "gl", "state", "controls", "panel", "view", "main")
FRAME_HEIGHT = 480  # pixels of a page in a notebook
EXTRAS = {
    "field": ("boxes",),
    "octree": ("blocks", "tiles", "tints"),
    "volume": ("transfer", "editor", "isosurfaces"),
}  # scripts of one kind alone
PASSES = {"octree": ("tiles.vert", "tiles.frag", "spots.vert")}  # shaders of one kind alone
# OpenCL C of the kernels' headers, and what GLSL has for it.
GLSL_FOR = (
    (r"const ints (\w+) = to_ints", r"int \1 = to_ints"),
    (r"\bconst (?=floats )", ""),
    (r"\bconst ints\b", "bool"),
    (r"\bfloats\b", "float"),
    (r"\bto_ints\(", "int("),
    (r"\bto_floats\(", "float("),
    (r"\bas_floats\(", "intBitsToFloat("),
    (r"\bANY\(", "("),
    (r"&(?=\w)", ""),
)
# Comments on lines of their own, at the end of a line, and types within a line of a script.
_COMMENT = re.compile(
    r"^\s*(//[^\n]*|/\*\*((?!\*/).)*\*/)\n| +// [^\n]*|/\*\* @type [^*]*\*/ ?",
    re.MULTILINE | re.DOTALL,
)
# Texts of a script, which stay as they are, and directives of a shader; or a punctuation mark with
# spaces. A sign after another keeps its space.
_SPACED = re.compile(
    r'("(?:[^"\\\n]|\\.)*"|`[^`]*`|^#.*$)| *([-+*/%<>=!&|^?:;,(){}\[\]]) *(?![-+])', re.MULTILINE
)


@dataclass(frozen=True, eq=False)
class Page:
    """An interactive page.

    html : the file. blocks : the compressed data by name. content : what it shows. served :
    whether the data are served beside the page instead of being in it.
    """

    html: str
    blocks: Mapping[str, bytes]
    content: PageContent
    served: bool = False

    @property
    def data_bytes(self) -> int:
        """Bytes of the compressed data; in the page they are base64."""
        sizes = map(len, self.blocks.values())
        return sum(size if self.served else 4 * -(-size // 3) for size in sizes)

    @property
    def base_bytes(self) -> int:
        """Bytes of the page without its data."""
        return len(self.html.encode()) - (0 if self.served else self.data_bytes)

    def _repr_html_(self) -> str:
        """Return the frame that a notebook shows."""
        return (
            f'<iframe srcdoc="{html.escape(self.html)}" sandbox="allow-scripts allow-downloads" '
            f'style="width: 100%; height: {FRAME_HEIGHT}px; border: 0"></iframe>'
        )


def page_of(
    content: PageContent, name: str, facts: Mapping[str, Any], served: bool = False
) -> Page:
    """Return the page of content from a file of this name; `facts` are added to the content's.
    Data that are served are not in the page but beside it."""
    name = printable(name)  # bytes of a name that are no UTF-8 are no text of a page
    blocks = {key: packed(array) for key, array in content.arrays.items()}
    types = {key: {"type": array.dtype.str[1:]} for key, array in content.arrays.items()}
    told = {
        **content.facts,
        **facts,
        "arrays": types,
        "size": f"{human(content.nbytes)} of data",
        "file": name,
        "name": re.sub(r"(?<=.)\..*", "", Path(name).name),
    }
    script = f'"use strict";\n(() => {{\n{_scripts(content.kind)}run({content.kind}Kind);\n}})();\n'
    style = _asset("page.css")
    values = {
        "policy": _policy(script, style, served),
        "title": html.escape(f"{content.kind} {Path(name).name}"),
        "label": html.escape(f"{content.kind} {Path(name).name}, interactive picture"),
        "style": style,
        "facts": json.dumps(told, separators=(",", ":")).replace("<", "\\u003c"),
        "vertex": _squeezed(_asset("screen.vert")),
        "fragment": fragment_of(content),
        "shaders": "\n".join(map(_shader, PASSES.get(content.kind, ()))),
        "blocks": "" if served else "\n".join(map(_block, blocks, blocks.values())),
        "script": script,
    }
    return Page(Template(_asset("page.html")).substitute(values), blocks, content, served)


def packed(array: np.ndarray) -> bytes:
    """Return an array deflated, with the bytes of its elements plane by plane."""
    little = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).reshape(-1)
    planes = little.view(np.uint8).reshape(-1, little.itemsize).T
    return zlib.compress(planes.tobytes(), 9)


def fragment_of(content: PageContent) -> str:
    """Return the fragment shader of content; brightness and integrals are those of the kernels."""
    defined = "".join(f"#define {name}\n" for name in content.defines)
    kernels = ["shading.h", *([content.kernel] if content.kernel else [])]
    parts = [_asset(name) for name in (*content.shaders, f"{content.kind}.frag")]
    return _squeezed("".join([_asset("rays.glsl"), defined, *map(glsl_of, kernels), *parts]))


@functools.cache
def glsl_of(header: str) -> str:
    """Return a header of the kernels as GLSL: one lane, results by `out`, no constant variables."""
    text = (kernel_folder() / header).read_text(encoding="utf-8")
    text = re.sub(r'^#include "lanes.h"\n', "", _bare(text), flags=re.MULTILINE)
    results = set(re.findall(r"floats \*(\w+)", text))
    for name in results:
        text = re.sub(rf"floats \*{name}\b", f"out floats {name}", text)
        text = re.sub(rf"\*{name}\b", name, text)
    for pattern, with_ in GLSL_FOR:
        text = re.sub(pattern, with_, text)
    return text


@functools.cache
def _scripts(kind: str) -> str:
    """Return the script of a kind of content."""
    names = *SHARED, *EXTRAS.get(kind, ()), kind
    return _squeezed("".join(_asset(f"{name}.js") for name in names))


def _asset(name: str) -> str:
    """Return a file of the page, bare. No text of a script may hold the two slashes of a comment
    between spaces."""
    return _bare((ASSETS / name).read_text(encoding="utf-8"))


def _bare(text: str) -> str:
    """Return a text without comments, indentation and empty lines."""
    return re.sub(r"^\s+", "", _COMMENT.sub("", text), flags=re.MULTILINE)


def _squeezed(code: str) -> str:
    """Return a script or shader without spaces around punctuation. No template of a script may be
    within another, and no regular expression may hold a quote or a space."""
    return _SPACED.sub(lambda match: match[1] or match[2], code)


def _policy(script: str, style: str, served: bool) -> str:
    """Return the content security policy of a page."""

    def source(text: str) -> str:
        return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"

    reach = "connect-src 'self'; " if served else ""
    return (
        f"default-src 'none'; {reach}img-src blob: data:; script-src {source(script)}; "
        f"style-src {source(style)}"
    )


def _shader(name: str) -> str:
    """Return the element of a shader."""
    return f'<script type="x-shader" id="{name}">{_squeezed(_asset(name))}</script>'


def _block(name: str, block: bytes) -> str:
    """Return the element of a block of data."""
    text = base64.b64encode(block).decode()
    return f'<script type="application/octet-stream" id="data-{name}">{text}</script>'
