"""Measure what small calls cost: the table of docs/performance.md.

    python examples/call_costs.py MESH [--repeat 31]

Each figure is the median of repeated calls after two that are not counted. Where a device can be
passed, calls with and without it alternate.
"""

import argparse
import statistics
import time
import warnings

import numpy as np

import voxtool


def median_ms(calls, repeat):
    """Return the median milliseconds of each of several calls that take turns."""
    times = [[] for _ in calls]
    for _ in range(repeat + 2):
        for call, spent in zip(calls, times, strict=True):
            start = time.perf_counter()
            call()
            spent.append(1e3 * (time.perf_counter() - start))
    return [statistics.median(spent[2:]) for spent in times]


def main():
    parser = argparse.ArgumentParser(description="Measure what small calls cost.")
    parser.add_argument("mesh")
    parser.add_argument("--repeat", type=int, default=31)
    asked = parser.parse_args()
    warnings.simplefilter("ignore", voxtool.MeshWarning)
    mesh, device = voxtool.load_mesh(asked.mesh), voxtool.open_device()
    grid = voxtool.Grid.fit(mesh, 64)
    field = voxtool.build_adf(mesh, max_level=7)
    low, high = mesh.bounds
    points = np.random.default_rng(1).uniform(low, high, (1000, 3))
    works = {
        "voxelize, dim 64": lambda **on: voxtool.voxelize(mesh, grid, **on),
        "voxelize, dim 64, parity": lambda **on: voxtool.voxelize(mesh, grid, fill="parity", **on),
        "query_adf, one point": lambda **on: voxtool.query_adf(field, points[0], **on),
        "query_adf, 1,000 points": lambda **on: voxtool.query_adf(field, points, **on),
        "distance, one point": lambda **on: voxtool.distance(mesh, points[0], **on),
        "distance, 1,000 points": lambda **on: voxtool.distance(mesh, points, **on),
    }
    print(f"{device.info.name} ({device.info.platform})\n")
    print("| call | without a device, ms | with one, ms | ratio |")
    print("| --- | ---: | ---: | ---: |")
    for name, work in works.items():
        without, passed = median_ms([work, lambda work=work: work(device=device)], asked.repeat)
        print(f"| {name} | {without:.3f} | {passed:.3f} | {without / passed:.2f} |")


if __name__ == "__main__":
    main()
