"""Reads what an ONNX file says about itself, without loading it: just enough of protobuf's wire format."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

MAX_DEPTH = 32

# Field numbers of onnx.proto: message -> field -> message it holds.
_CHILDREN: dict[str, dict[int, str]] = {
    "Model": {7: "Graph", 8: "Opset", 25: "Function"},
    "Graph": {1: "Node", 5: "Tensor", 15: "Sparse"},
    "Function": {7: "Node", 9: "Opset", 11: "Attribute"},
    "Node": {5: "Attribute"},
    "Attribute": {5: "Tensor", 6: "Graph", 10: "Tensor", 11: "Graph", 22: "Sparse", 23: "Sparse"},
    "Sparse": {1: "Tensor", 2: "Tensor"},
    "Tensor": {},
    "Opset": {},
}
_TRAINING = 20
"""Field of a model that is refused: more graphs and weights, which no robot needs."""
_NODE_OPERATOR, _NODE_DOMAIN = 4, 7
_OPSET_DOMAIN, _OPSET_VERSION = 1, 2
_TENSOR_EXTERNAL_DATA, _TENSOR_DATA_LOCATION = 13, 14
_STANDARD_DOMAINS = ("", "ai.onnx")


class OnnxFileError(ValueError):
    """Bytes that are no ONNX model, or none that is accepted."""


@dataclass(frozen=True)
class OnnxFacts:
    """What matters for trusting a model."""

    opset: int
    """Version of the standard operators; 0 if none is imported."""
    custom_operators: tuple[str, ...]
    """Operators from outside of the standard, as domain.name."""
    external_data: bool
    """Whether a tensor's values lie in another file."""


def inspect_onnx(data: bytes) -> OnnxFacts:
    """Walk a serialised model.

    Raises:
        OnnxFileError: `data` is not a serialised ONNX model, or is one that is to be trained.
    """
    walk = _Walk()
    walk.message("Model", memoryview(data), 0)
    if not walk.graphs:
        raise OnnxFileError("no graph in it")
    return OnnxFacts(walk.opset, tuple(sorted(walk.custom)), walk.external)


class _Walk:
    def __init__(self) -> None:
        self.opset = 0
        self.graphs = 0
        self.custom: set[str] = set()
        self.external = False

    def message(self, kind: str, data: memoryview, depth: int) -> None:
        if depth > MAX_DEPTH:
            raise OnnxFileError(f"nested deeper than {MAX_DEPTH} levels")
        children = _CHILDREN[kind]
        texts: dict[int, str] = {}
        version = 0
        for number, value in _fields(data):
            if kind == "Model" and number == _TRAINING:
                raise OnnxFileError("it holds training_info, and nothing is trained here")
            if isinstance(value, int):
                if kind == "Tensor" and number == _TENSOR_DATA_LOCATION and value != 0:
                    self.external = True
                if kind == "Opset" and number == _OPSET_VERSION:
                    version = value
            elif number in children:
                self.message(children[number], value, depth + 1)
            elif kind == "Tensor" and number == _TENSOR_EXTERNAL_DATA:
                self.external = True
            elif (kind == "Node" and number in (_NODE_OPERATOR, _NODE_DOMAIN)) or (
                kind == "Opset" and number == _OPSET_DOMAIN
            ):
                texts[number] = bytes(value).decode("utf-8", "replace")
        if kind == "Graph":
            self.graphs += 1
        elif kind == "Node":
            domain = texts.get(_NODE_DOMAIN, "")
            if domain not in _STANDARD_DOMAINS:
                self.custom.add(f"{domain}.{texts.get(_NODE_OPERATOR, '?')}")
        elif kind == "Opset" and texts.get(_OPSET_DOMAIN, "") in _STANDARD_DOMAINS:
            self.opset = max(self.opset, version)


def _fields(data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Field numbers and values of a message: integers, or the bytes of what has a length; fixed widths as bytes."""
    at, end = 0, len(data)
    while at < end:
        key, at = _varint(data, at)
        number, wire_type = key >> 3, key & 7
        if number == 0:
            raise OnnxFileError("field number 0")
        if wire_type == 0:
            value, at = _varint(data, at)
            yield number, value
            continue
        if wire_type == 2:
            length, at = _varint(data, at)
        elif wire_type in (1, 5):
            length = 8 if wire_type == 1 else 4
        else:
            raise OnnxFileError(f"wire type {wire_type}")
        if at + length > end:
            raise OnnxFileError(f"{at + length - end} bytes are missing")
        yield number, data[at : at + length]
        at += length


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(data):
            raise OnnxFileError("it ends within a number")
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise OnnxFileError("a number longer than 64 bits")
