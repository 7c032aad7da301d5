"""Measure how fast pages draw in Chromium on SwiftShader: a table, in Markdown.

    python -m tests.frame_rates bunny.obj volume.vtu

The octree of dim 512 and the field of level 7 of the mesh, and the volume, are drawn whole at
512 x 512 pixels, and then for some seconds while the camera turns, at the size that the page
chooses. Processor time is that of all processes of the browser: other work disturbs it less than
it disturbs the time of the fastest picture. Fetches are the texels that the fragment shader reads,
which counts them, as a mean over the pixels of a smaller picture.
"""

from __future__ import annotations

import argparse
import os
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from helpers.browser import Viewer, open_browser, written

import voxtool
from tests.performance_page import markdown

SIDE = 512  # pixels
COUNTED_SIDE = 128  # pixels of the picture whose fetches are counted
PICTURES = 5
TURNING = 4.0  # seconds
DRAW = """async ([pictures, seconds]) => {
  const { view, state } = voxtool;
  const idle = async () => {
    while (view.busy) await new Promise((done) => setTimeout(done, 1));
    return view.milliseconds;
  };
  const times = [];
  for (let i = 0; i < pictures; ++i) { view.draw(1); times.push(await idle()); }
  const { camera } = state(), [c, s] = [Math.cos(0.02), Math.sin(0.02)];
  const end = performance.now() + 1e3 * seconds;
  let frames = 0;
  for (; performance.now() < end; ++frames) {
    const [x, y, z] = camera.eye.map((v, a) => v - camera.target[a]);
    camera.eye = [c * x + s * z, y, c * z - s * x].map((v, a) => v + camera.target[a]);
    view.frame();
    await idle();
  }
  return { times, frames, side: view.target.width };
}"""
COUNTER = """
highp uint fetches = 0u;
#define texelFetch(list, at, level) (++fetches, texelFetch(list, at, level))
"""
TOLD = "void main() { uncounted(); id = uvec4(fetches, 0, 0, id.w); }"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.frame_rates", description=__doc__)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("volume", type=Path)
    given = parser.parse_args()
    contents = {
        f"octree of {given.mesh.stem}, dim 512": voxtool.voxelize(given.mesh, dim=512),
        f"field of {given.mesh.stem}, level 7": voxtool.build_adf(
            given.mesh, tolerance=1e-3, max_level=7
        ),
        f"volume {given.volume.stem}": voxtool.build_tet(given.volume),
    }
    heads = (
        "page",
        "processor, s",
        "fastest, ms",
        "a second",
        "turning: pixels",
        "a second",
        "fetches a pixel",
    )
    with open_browser() as browser, tempfile.TemporaryDirectory() as folder:
        rows = [
            [name, *row(browser, written(content, Path(folder)))]
            for name, content in contents.items()
        ]
        print(markdown([heads, *rows]), f"Chromium {browser.version}.", sep="\n\n")


def row(browser: Any, page: Path) -> list[str]:
    """The cells of a page."""
    viewer = Viewer(browser, page, size=(SIDE, SIDE))
    viewer.wait("!voxtool.view.busy")
    viewer.tab.evaluate(DRAW, [1, 0])  # a warm-up
    before = processor_seconds()
    times = viewer.tab.evaluate(DRAW, [PICTURES, 0])["times"]
    spent = (processor_seconds() - before) / PICTURES
    turning = viewer.tab.evaluate(DRAW, [0, TURNING])
    viewer.close()
    rate, moving = 1e3 / min(times), turning["frames"] / TURNING
    side = turning["side"]
    cells = f"{spent:.2f}", f"{min(times):.0f}", f"{rate:.2g}", f"{side} x {side}", f"{moving:.2g}"
    return [*cells, f"{fetches(browser, page, COUNTED_SIDE).mean():.1f}"]


def fetches(browser: Any, page: Path, side: int) -> np.ndarray:
    """The texels that the fragment shader of a page fetches for each pixel."""
    html = page.read_text(encoding="utf-8")
    shader = re.search(r'(?<=id="fragment">#version 300 es\n).*?(?=</script>)', html, re.DOTALL)
    assert shader
    counted = COUNTER + shader[0].replace("void main()", "void uncounted()") + TOLD
    copy = page.with_name("counted.html")
    copy.write_text(html.replace(shader[0], counted), encoding="utf-8")
    viewer = Viewer(browser, copy)
    ids = viewer.picture(side, side)[1]
    viewer.close()
    return ids[..., 0]


def processor_seconds(root: int | None = None) -> float:
    """Seconds that the processes begun by `root`, this one by default, and by those, have run; of
    Linux."""
    root = root or os.getpid()
    parents: dict[int, int] = {}
    spent: dict[int, int] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            words = path.read_text().rpartition(")")[2].split()  # a name may have spaces
        except OSError:  # it has ended
            continue
        number = int(path.parent.name)
        parents[number], spent[number] = int(words[1]), int(words[11]) + int(words[12])
    found = {root}
    while more := {n for n, parent in parents.items() if parent in found} - found:
        found |= more
    return sum(spent[n] for n in found - {root}) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()
