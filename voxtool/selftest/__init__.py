"""Whether a device computes right: the stiff and the extreme, each against an oracle.

An oracle is another algorithm (rational arithmetic, quadrature, clipping), a formula, or a digest
that is the same on every device. Nothing here is random from run to run.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from voxtool.selftest import arithmetic, digests, fields, volumes, voxels
from voxtool.selftest.case import Case, Outcome

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.opencl import Device

CASES: tuple[Case, ...] = (
    *arithmetic.CASES,
    *voxels.CASES,
    *fields.CASES,
    *volumes.CASES,
    *digests.CASES,
)


def selftest(device: Device, full: bool = False) -> Iterator[Outcome]:
    """The outcome of every case, as soon as it is there.

    Parameters
    ----------
    full : more and larger inputs, which take minutes.
    """
    for case in CASES:
        yield case.run(device, full)
