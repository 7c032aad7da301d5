"""Checks of a device: stiff and extreme cases, each compared with an oracle.

An oracle is another algorithm (rational arithmetic, quadrature, clipping), a formula, or a digest
that is the same on every device. Every run computes the same cases.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from voxtool.selftest import (
    adaptive,
    areas,
    arithmetic,
    booleans,
    connected,
    contacts,
    deep,
    digests,
    exchange,
    exposed,
    fields,
    fractions,
    links,
    merging,
    morphology,
    pages,
    parts,
    points,
    repairs,
    thin,
    unions,
    volumes,
    voxels,
)
from voxtool.selftest.case import Case, Outcome

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.opencl import Device

CASES: tuple[Case, ...] = (
    *arithmetic.CASES,
    *voxels.CASES,
    *fractions.CASES,
    *areas.CASES,
    *exposed.CASES,
    *parts.CASES,
    adaptive.surfaces,
    deep.surfaces,
    connected.frames,
    unions.unions,
    contacts.contacts,
    booleans.operations,
    merging.subtrees,
    points.points,
    points.nearest,
    *morphology.CASES,
    *links.CASES,
    repairs.soup,
    *fields.CASES,
    thin.bounds,
    *volumes.CASES,
    *pages.CASES,
    *exchange.CASES,
    *digests.CASES,
)


def selftest(
    device: Device, full: bool = False, cases: tuple[Case, ...] = CASES
) -> Iterator[Outcome]:
    """Yield the outcome of each case, as soon as it is known.

    Parameters
    ----------
    full : more and larger inputs, which take minutes.
    """
    for case in cases:
        yield case.run(device, full)
