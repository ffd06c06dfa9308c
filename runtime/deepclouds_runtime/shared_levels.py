"""A network cut in two: what it makes of the coarse levels of a stencil, and what it makes of that and the fine ones.

A network that goes from coarse to fine holds, between two levels, all that it took from the coarser ones in one vector. Points that lie
close together see the same coarse surroundings: known at the corners of a cell, the vector is interpolated for the points in between, which
need neither the coarse levels of a stencil nor the first part of the network.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from deepclouds.model import INPUT_STENCIL, LEVELS, OUTPUT

if TYPE_CHECKING:
    from onnx import ModelProto

# Coarse levels that are shared where cells have edges of up to so many units of length: the farther apart its points, the coarser what
# they have in common. Measured: docs/LOG.md.
_SHARED = ((2.0, 7), (4.0, 6), (8.0, 5))


def shared_levels(spacing: float) -> int:
    """How many of the coarsest levels cells of edge `spacing`, in units of length, share; 0 where they are too large."""
    return next((levels for most, levels in _SHARED if spacing <= most * (1 + 1e-6)), 0)


def cut(model: ModelProto, shared: int) -> str | None:
    """Name of the tensor that holds all that a graph takes from its `shared` coarsest levels; None where there is no such tensor."""
    if not 0 < shared < LEVELS:
        return None
    of = _levels_of(model)
    coarse = frozenset(range(LEVELS - shared, LEVELS))
    makers = {name: node for node in model.graph.node for name in node.output}
    # The last one: nothing that can be done before it is done after it.
    return next((name for name in reversed(of) if of[name] == coarse and not _reaches(makers, of, coarse, name)), None)


def read_levels(model: ModelProto) -> list[int]:
    """Levels of a stencil that a graph looks at."""
    of = _levels_of(model)
    return sorted(frozenset().union(*(of[name] for node in model.graph.node if INPUT_STENCIL in node.input for name in node.output)))


def halves(model: ModelProto, tensor: str) -> tuple[bytes, bytes]:
    """Two graphs: stencil, aux -> j and the tensor; fine levels of a stencil, aux and the tensor -> j."""
    import onnx
    from onnx.utils import Extractor

    first = onnx.ModelProto()
    first.CopyFrom(model)
    first.graph.output.append(onnx.helper.make_empty_tensor_value_info(tensor))
    inputs = [value.name for value in model.graph.input]
    second = Extractor(onnx.shape_inference.infer_shapes(model)).extract_model([*inputs, tensor], [OUTPUT])
    for value in second.graph.input:
        if value.name == INPUT_STENCIL:
            value.type.tensor_type.shape.dim[1].dim_param = "fine"
    return first.SerializeToString(), second.SerializeToString()


def _constants(model: ModelProto) -> dict[str, Any]:
    """Small integers that the graph has as initialisers or constants, by name."""
    from onnx import TensorProto, numpy_helper

    found = {i.name: numpy_helper.to_array(i) for i in model.graph.initializer if i.data_type == TensorProto.INT64}
    for node in model.graph.node:
        if node.op_type == "Constant":
            found |= {name: numpy_helper.to_array(a.t) for a in node.attribute if a.name == "value" for name in node.output}
    return found


def _levels_of(model: ModelProto) -> dict[str, frozenset[int]]:
    """Levels of the stencil that each tensor of a graph depends on."""
    constants = _constants(model)
    of: dict[str, frozenset[int]] = {}
    for node in model.graph.node:
        if INPUT_STENCIL in node.input:
            levels = _sliced(node, constants)
        else:
            levels = frozenset().union(*(of.get(name, frozenset()) for name in node.input))
        of |= dict.fromkeys(node.output, levels)
    return of


def _sliced(node: Any, constants: dict[str, Any]) -> frozenset[int]:
    """Levels that a node takes from the stencil: all of them, unless it is a plain slice that counts from the finest."""
    every = frozenset(range(LEVELS))
    if node.op_type != "Slice" or len(node.input) not in (4, 5) or any(name not in constants for name in node.input[1:]):
        return every
    start, stop, axis, *step = (np.ravel(constants[name]) for name in node.input[1:])
    # A slice that counts from the end would take another level of a stencil that lacks the coarse ones.
    if len(axis) != 1 or axis[0] not in (1, -2) or start[0] < 0 or stop[0] <= 0:
        return every
    return frozenset(range(LEVELS)[int(start[0]) : int(stop[0]) : int(step[0][0]) if step else 1])


def _reaches(makers: dict[str, Any], of: dict[str, frozenset[int]], coarse: frozenset[int], tensor: str) -> bool:
    """Whether the output needs any of the `coarse` levels by a way that does not lead through a tensor."""
    waiting, done = [OUTPUT], {tensor}
    while waiting:
        name = waiting.pop()
        if name in done or name not in makers:
            continue
        done.add(name)
        node = makers[name]
        if INPUT_STENCIL in node.input and of[name] & coarse:
            return True
        waiting += [value for value in node.input if of.get(value)]
    return False
