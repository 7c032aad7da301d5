"""Shows `voxelize = one_call(plan_voxelize, "voxelize", Octree)` as a function in the pages of the
API: with the parameters and the documentation of plan_voxelize, and the result Octree."""

from __future__ import annotations

from typing import Any

import griffe


class OneCall(griffe.Extension):
    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: Any) -> None:
        """Replace a module's attribute by a function if its value is a call of one_call."""
        call, module = attr.value, attr.parent
        if isinstance(call, griffe.ExprCall) and str(call.function) == "one_call":
            plan, _, result = call.arguments
            source = module[str(plan)]
            function = griffe.Function(
                attr.name, parameters=source.parameters, returns=result, docstring=source.docstring
            )
            module.set_member(attr.name, function)
