"""Compare meshes and their octrees with the digests in a golden file.

    python examples/regression.py golden.json              exit 1 and a diff if one changed
    python examples/regression.py golden.json --update     write the current results

The golden file lists cases. Paths are relative to its folder; the other keys are arguments of
voxtool.Grid.fit and voxtool.voxelize. --update fills in `result`:

    [{"mesh": "bunny.obj", "dim": 64, "mode": "solid"},
     {"mesh": "bunny.obj", "pitch": 0.05, "mode": "surface26"}]

Octrees are the same on every device, so one golden file serves every machine.
"""

import argparse
import json
import os
import sys
from pathlib import Path

import voxtool

GRID = ("dim", "pitch", "bbox", "margin", "fit")
VOXELIZE = ("mode", "fill", "gap", "with_surface")


def run(case, folder, device):
    """Return the current result of a case: a few numbers and a digest."""
    if not isinstance(case, dict) or "mesh" not in case:
        raise voxtool.VoxtoolError(f"{json.dumps(case)} is not a case: it names no mesh")
    unknown = sorted(set(case) - {"mesh", "result", *GRID, *VOXELIZE})
    if unknown:
        raise voxtool.VoxtoolError(f"case of {case['mesh']}: {', '.join(unknown)} is unknown")
    mesh = voxtool.load_mesh(folder / case["mesh"])
    grid = voxtool.Grid.fit(mesh, **{name: case[name] for name in GRID if name in case})
    options = {name: case[name] for name in VOXELIZE if name in case}
    octree = voxtool.voxelize(mesh, grid, device=device, **options)
    return {
        "triangles": len(mesh.faces),
        "shape": list(grid.shape),
        "voxels": octree.count,
        "nodes": len(octree.nodes),
        "digest": octree.digest(),
    }


def title(case):
    options = " ".join(f"{name} {case[name]}" for name in (*GRID, *VOXELIZE) if name in case)
    return f"{case['mesh']} {options}".rstrip()


def difference(golden, found):
    """Lines that say what changed, the numbers first."""
    if golden is None:
        return ["no golden result yet: run with --update"]
    names = dict.fromkeys([*golden, *found])
    return [
        f"{name}: {golden.get(name)} -> {found.get(name)}"
        for name in names
        if golden.get(name) != found.get(name)
    ]


def main():
    parser = argparse.ArgumentParser(description="Compare digests of octrees with a golden file.")
    parser.add_argument("golden", type=Path)
    parser.add_argument("--update", action="store_true", help="write the current results")
    parser.add_argument("--device", help="as in voxtool voxelize --device")
    arguments = parser.parse_args()
    try:
        cases = json.loads(arguments.golden.read_text(encoding="utf-8"))
        device = voxtool.open_device(arguments.device)
        found = [run(case, arguments.golden.parent, device) for case in cases]
    except (OSError, ValueError, TypeError, voxtool.VoxtoolError) as error:
        sys.exit(f"regression: error: {error}")

    changed = 0
    for case, result in zip(cases, found, strict=True):
        lines = difference(case.get("result"), result)
        changed += bool(lines)
        print(f"{'changed' if lines else 'same   '} {title(case)}")
        for line in lines:
            print(f"    {line}")
        case["result"] = result
    if arguments.update:
        text = "[\n" + ",\n".join(f"  {json.dumps(case)}" for case in cases) + "\n]\n"
        beside = arguments.golden.with_suffix(".tmp")
        beside.write_text(text, encoding="utf-8")
        os.replace(beside, arguments.golden)
        print(f"{arguments.golden}: {changed} of {len(cases)} updated")
    elif changed:
        print(f"{changed} of {len(cases)} cases changed; if that is meant, run with --update")
        sys.exit(1)


if __name__ == "__main__":
    main()
