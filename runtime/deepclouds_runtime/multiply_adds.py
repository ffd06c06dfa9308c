"""Multiply-adds of a query, counted in the graph of a model file."""

from __future__ import annotations

from math import prod
from typing import Any

from deepclouds.errors import InputError


def multiply_adds(model: bytes) -> int:
    """Multiply-adds of the matrix products (MatMul, Gemm, Conv) for one query of a graph.

    A matrix that is used for several levels counts as often as it is used, which its size alone does not tell.

    Parameters
    ----------
    model
        an ONNX file whose inputs have the batch as their first dimension.

    Raises
    ------
    InputError
        when the shape of a product cannot be inferred.
    """
    import onnx

    proto = onnx.load_from_string(model)
    for value in proto.graph.input:
        value.type.tensor_type.shape.dim[0].dim_value = 1
    del proto.graph.value_info[:]
    for value in proto.graph.output:
        value.type.tensor_type.ClearField("shape")
    graph = onnx.shape_inference.infer_shapes(proto, strict_mode=True, data_prop=True).graph
    shapes: dict[str, tuple[int, ...] | None] = {v.name: _shape(v) for v in [*graph.input, *graph.value_info, *graph.output]}
    shapes |= {i.name: tuple(i.dims) for i in graph.initializer}
    total = 0
    for node in graph.node:
        if node.op_type not in ("MatMul", "Gemm", "Conv"):
            continue
        left, right, result = (shapes.get(name) for name in (node.input[0], node.input[1], node.output[0]))
        if left is None or right is None or result is None:
            raise InputError(f"the shapes of the {node.op_type} '{node.name}' are unknown: multiply-adds cannot be counted")
        if node.op_type == "Conv":
            inner = prod(right[1:])
        elif node.op_type == "Gemm" and any(a.name == "transA" and a.i for a in node.attribute):
            inner = left[0]
        else:
            inner = left[-1]
        total += prod(result) * inner
    return total


def _shape(value: Any) -> tuple[int, ...] | None:
    kind = value.type.tensor_type
    if not kind.HasField("shape") or not all(d.HasField("dim_value") for d in kind.shape.dim):
        return None
    return tuple(d.dim_value for d in kind.shape.dim)
