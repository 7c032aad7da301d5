"""Plans: what they tell, and that the names in their tables exist."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator
from dataclasses import dataclass, fields
from string import Formatter

import pytest

import voxtool
from voxtool.errors import MemoryLimitError
from voxtool.job import Cost, Plan


@dataclass(frozen=True)
class Sawing(Plan):
    """A plan that is not in the package."""

    stages = ("measure", "saw")
    facts = ("wood", "length: sizes.device", "ends")
    predicted, costs = ("boards: count",), ("device", "host")
    refusal = "{plan.count:,} boards of {plan.wood} {shortage}: choose shorter ones"

    wood: str
    count: int
    sizes: Cost
    ends: tuple[tuple[int, int], ...] = ((1, 2), (3, 4))

    @property
    def reasons(self) -> dict[str, str]:
        return {"planing": "" if self.wood == "oak" else "it is smooth", "glue": ""}

    @property
    def cost(self) -> Cost:
        return self.sizes

    def rows(self) -> list[tuple[str, str]]:
        return [("wood", self.wood)]


def test_a_plan_tells_its_tables_in_order() -> None:
    plan = Sawing("beech", 1200, Cost(2000, 30, 400))
    assert list(plan.as_dict().items()) == [
        ("wood", "beech"),
        ("length", 2000),
        ("ends", [[1, 2], [3, 4]]),
        ("stages", ["measure", "saw"]),
        ("left_out", {"planing": "it is smooth"}),
        ("predicted_boards", 1200),
        ("predicted_device_bytes", 2000),
        ("predicted_host_bytes", 30),
    ]
    assert Sawing("oak", 1, plan.sizes).left_out == {}


def test_a_plan_is_refused_by_the_memory_of_the_device_or_of_the_host() -> None:
    plan = Sawing("oak", 1200, Cost(2000, 30, 400))
    plan.refuse_beyond(2000, 400)
    lacks = r"^1,200 boards of oak would need 2 kB of memory \(400 bytes in one buffer\), of "
    for limits, allowed in (((1999, 400), r"2 kB \(400 bytes\)"), ((2000, 399), r"2 kB \(399")):
        with pytest.raises(MemoryLimitError, match=f"{lacks}{allowed}.*: choose shorter ones$"):
            plan.refuse_beyond(*limits)
    alone = Sawing("oak", 3, Cost(0, 30))
    alone.refuse_beyond(30, 0)
    with pytest.raises(MemoryLimitError, match=r"would need 30 bytes of memory, of 29 bytes all"):
        alone.refuse_beyond(29, 0)


def test_the_most_of_costs() -> None:
    assert Cost.most([Cost(1, 5, 2), Cost(3, 4, 0)]) == Cost(3, 5, 2)
    assert Cost.most([]) == Cost(0)


def plans(base: type[Plan]) -> Iterator[type[Plan]]:
    for plan in base.__subclasses__():
        yield plan
        yield from plans(plan)


def test_the_names_in_the_tables_of_plans_exist() -> None:
    for module in pkgutil.walk_packages(voxtool.__path__, "voxtool."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    found = [plan for plan in plans(Plan) if plan.__module__.startswith("voxtool.")]
    assert len(found) > 25
    for plan in found:
        known = {*dir(plan), *(f.name for f in fields(plan))}  # pyright: ignore
        named = [
            (name.partition(": ")[2] or name) for name in (*(plan.facts or ()), *plan.predicted)
        ]
        named += [
            name.removeprefix("plan.")
            for _, name, *_ in Formatter().parse(getattr(plan, "refusal", ""))
            if name and name != "shortage"
        ]
        missing = {name for name in named if name.partition(".")[0] not in known}
        assert not missing, plan
        assert {*plan.costs} <= {f.name for f in fields(Cost)}
