"""Text and facts of a job, as --plan prints them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from voxtool.errors import human

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from voxtool.job import Job


def planned(job: Job[Any], facts: Mapping[str, Any], after: Sequence[str]) -> dict[str, Any]:
    """Return the plan of a job with more facts, and the stages after its own, in JSON types."""
    stages = {"stages": [*job.stages, *after]} if after else {}
    return {**job.describe(), **facts, **stages}


def rows_of(job: Job[Any], after: Sequence[str]) -> list[tuple[str, str]]:
    """Return the plan of a job, the stages after its own, and the memory that it is predicted to
    take, as names and texts."""
    needs = {"the device": job.cost.device, "the host": job.cost.host}
    predicted = [f"{human(size)} on {where}" for where, size in needs.items() if size]
    return [
        *job.plan.rows(),
        ("stages", ", ".join([*job.stages, *after])),
        *(("left out", f"{what}: {why}") for what, why in job.left_out.items()),
        ("predicted", ", ".join(predicted)),
    ]
