"""Perceptrons of one shape side by side, differentiated by hand.

At two hidden layers and batches of 256, autograd's bookkeeping, fresh memory for every result and a cast of the weights
at every use take as long as the products themselves. Here results go where the last ones were, weights are cast once
per update, and only the gradients that are asked for are computed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from tensordict import TensorDictBase

_NORM_EPSILON = 1e-5  # of torch.nn.LayerNorm
_MINUS_INFINITY = -128  # whose bits in bfloat16 this integer has


class _Layer(NamedTuple):
    """A linear layer, or its gradients, and the gain and shift (K, out) of the layer norm behind it, if any."""

    weight: torch.Tensor
    """(K, out, in)"""
    bias: torch.Tensor
    """(K, 1, out)"""
    norm: Sequence[torch.Tensor] = ()


class Perceptrons:
    """K networks of `hiernav.skill.networks`, without the scaling of their inputs.

    `forward` leaves behind what `backward` needs; the next call of either overwrites the results of the last.

    Args:
        tree: "trunk" and "head" of the networks' parameters, with an axis of length K in front or, if K is 1, without.
            The parameters are moved: from here on they are views of `weights`.
        weights: float32 memory for them, `count(tree)` long.
        gradients: as much for their gradients; None for networks that do not learn.
        precision: of the products. Weights and gradients are kept, and the head computed, in float32.
    """

    def __init__(
        self,
        tree: TensorDictBase,
        weights: torch.Tensor,
        gradients: torch.Tensor | None = None,
        precision: torch.dtype = torch.float32,
    ) -> None:
        tensors = _tensors(tree)
        shapes = [[tensor.shape for tensor in layer] for layer in tensors]
        for layer, places in zip(tensors, _cut(weights, shapes), strict=True):
            for tensor, place in zip(layer, places, strict=True):
                tensor.data = place.copy_(tensor.data)
        self._master, self._weights = weights, weights.to(precision)
        *self._hidden, self._reduced_head = _layers(self._weights, shapes)
        self._head = _layers(weights, shapes)[-1]
        self.copies = len(self._head.weight)
        if gradients is not None:
            self._head_gradients = _layers(gradients, shapes)[-1]
            # the head's come last
            self._master_gradients = gradients[: -sum(shape.numel() for shape in shapes[-1])]
            self._gradients = self._master_gradients.to(precision)
            self._hidden_gradients = _layers(self._gradients, shapes[:-1])
        self._precision = precision
        self._kept: list[torch.Tensor] = []
        self._last = weights
        self._statistics: dict[int, list[tuple[torch.Tensor, torch.Tensor]]] = {}
        self._rooms: dict[tuple[str, int], torch.Tensor] = {}

    def read_weights(self) -> None:
        """Compute with the weights as they are now."""
        if self._weights is not self._master:
            self._weights.copy_(self._master)

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Outputs (K, B, O) of all networks for the same inputs (B, I)."""
        value = self._cast("inputs", inputs, self._precision).expand(self.copies, -1, -1)
        self._kept = [value]
        for k, layer in enumerate(self._hidden):
            room = self._room("hidden", k, (*value.shape[:2], layer.bias.shape[-1]), self._precision)
            value = torch.baddbmm(layer.bias, value, layer.weight.mT, out=room)
            if layer.norm:
                value = self._normalise(k, value)
            self._kept.append(_rectify(value))
        self._last = self._cast("last", value, torch.float32)
        return torch.baddbmm(self._head.bias, self._last, self._head.weight.mT)

    def backward(self, by_outputs: torch.Tensor, rows: slice) -> None:
        """Write the gradients of a loss into `gradients`, given its derivative (K, R, O) by those rows of outputs."""
        torch.bmm(by_outputs.mT, self._last[:, rows], out=self._head_gradients.weight)
        torch.sum(by_outputs, 1, keepdim=True, out=self._head_gradients.bias)
        for k, slope in self._slopes(by_outputs, rows, learning=True):
            torch.bmm(slope.mT, self._kept[k][:, rows], out=self._hidden_gradients[k].weight)
            torch.sum(slope, 1, keepdim=True, out=self._hidden_gradients[k].bias)
        if self._gradients is not self._master_gradients:
            self._master_gradients.copy_(self._gradients)

    def backward_to_inputs(self, by_outputs: torch.Tensor, rows: slice, columns: slice) -> torch.Tensor:
        """The derivative (R, C) of a loss by some columns of the inputs, summed over the networks."""
        *_, (_, slope) = self._slopes(by_outputs, rows, learning=False)
        return torch.bmm(slope, self._hidden[0].weight[:, :, columns]).sum(0, dtype=torch.float32)

    def _slopes(self, by_outputs: torch.Tensor, rows: slice, learning: bool) -> Iterator[tuple[int, torch.Tensor]]:
        """Derivatives (K, R, out) by the results of the hidden layers' products, from the last to the first."""
        slope = self._cast("slope", by_outputs, self._precision)
        for k in reversed(range(len(self._hidden))):
            weight = (*self._hidden, self._reduced_head)[k + 1].weight
            room = self._room("slope", k, (*slope.shape[:2], weight.shape[-1]), self._precision)
            # behind a single output, the product is one of a column and a row
            (torch.mul if weight.shape[1] == 1 else torch.bmm)(slope, weight, out=room)
            slope = self._silence(k, room, self._kept[k + 1][:, rows])
            if self._hidden[k].norm:
                self._denormalise(k, slope, rows, learning)
            yield k, slope

    def _normalise(self, k: int, value: torch.Tensor) -> torch.Tensor:
        """Layer norm (K, B, out) of hidden layer k."""
        normed, size = self._room("normed", k, value.shape, self._precision), value.shape[-1:]
        self._statistics[k] = []
        for n, (gain, shift) in enumerate(zip(*self._hidden[k].norm, strict=True)):
            result, mean, rstd = torch.native_layer_norm(value[n], size, gain, shift, _NORM_EPSILON)
            normed[n].copy_(result)
            self._statistics[k].append((mean, rstd))
        return normed

    def _denormalise(self, k: int, slope: torch.Tensor, rows: slice, learning: bool) -> None:
        """Turn the derivative (K, R, out) by the layer norm's results into that by its inputs, in place."""
        size = slope.shape[-1:]
        value = self._rooms["hidden", k]
        for n, ((gain, shift), (mean, rstd)) in enumerate(
            zip(zip(*self._hidden[k].norm, strict=True), self._statistics[k], strict=True)
        ):
            inputs, *weights = torch.ops.aten.native_layer_norm_backward(
                slope[n], value[n, rows], size, mean[rows], rstd[rows], gain, shift, [True, learning, learning]
            )
            slope[n].copy_(inputs)
            if learning:
                for place, gradient in zip(self._hidden_gradients[k].norm, weights, strict=True):
                    place[n].copy_(gradient)

    def _silence(self, k: int, slope: torch.Tensor, kept: torch.Tensor) -> torch.Tensor:
        """Nothing comes through a ReLU where its results `kept` are zero; in place."""
        if self._precision != torch.bfloat16:
            return torch.ops.aten.threshold_backward.grad_input(slope, kept, 0, grad_input=slope)
        # the bits of the smallest positive number are those of the integer one
        opened = torch.clamp_max(kept.view(torch.int16), 1, out=self._room("open", k, kept.shape, torch.int16))
        slope.view(torch.int16).mul_(opened)
        return slope

    def _cast(self, name: str, values: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
        return values if values.dtype == dtype else self._room(name, -1, values.shape, dtype).copy_(values)

    def _room(self, name: str, k: int, shape: Sequence[int], dtype: torch.dtype) -> torch.Tensor:
        """Memory that is kept from call to call; new only where another shape is asked for."""
        room = self._rooms.get((name, k))
        if room is None or room.shape != shape:
            room = self._rooms[name, k] = torch.empty(shape, dtype=dtype, device=self._weights.device)
        return room


def count(tree: TensorDictBase) -> int:
    """How many numbers the parameters of networks hold."""
    return sum(tensor.numel() for layer in _tensors(tree) for tensor in layer)


def parameters(tree: TensorDictBase) -> list[torch.Tensor]:
    """The parameters of networks in the order in which `Perceptrons` puts them into memory."""
    return [tensor for layer in _tensors(tree) for tensor in layer]


def _rectify(values: torch.Tensor) -> torch.Tensor:
    """ReLU in place."""
    if values.dtype != torch.bfloat16:
        return values.relu_()
    # by their bits, four times as fast: as integers, numbers below zero are at most what -inf is, and NaN is above
    torch.threshold_(values.view(torch.int16), _MINUS_INFINITY, 0)
    return values


def _tensors(tree: TensorDictBase) -> list[list[torch.Tensor]]:
    """Weight and bias of each layer, gain and shift of its layer norm if it has one; the head last."""
    trunk, head = tree["trunk", "layers"], tree["head"]
    layers: list[list[torch.Tensor]] = []
    for key in sorted(trunk.keys(), key=int):
        pair = [trunk[key, "weight"], trunk[key, "bias"]]
        # a weight with as many axes as its bias is a layer norm's
        if pair[0].ndim == pair[1].ndim:
            layers[-1] += pair
        else:
            layers.append(pair)
    return [*layers, [head["weight"], head["bias"]]]


def _cut(flat: torch.Tensor, shapes: Sequence[Sequence[torch.Size]]) -> list[list[torch.Tensor]]:
    """Consecutive views of a piece of memory."""
    pieces: list[list[torch.Tensor]] = []
    start = 0
    for layer in shapes:
        pieces.append([])
        for shape in layer:
            pieces[-1].append(flat[start : start + shape.numel()].view(shape))
            start += shape.numel()
    return pieces


def _layers(flat: torch.Tensor, shapes: Sequence[Sequence[torch.Size]]) -> list[_Layer]:
    """Consecutive layers in a piece of memory, with the axis of the networks in front."""
    layers = []
    for weight, bias, *norm in _cut(flat, shapes):
        width = bias.shape[-1]
        layers.append(
            _Layer(weight.view(-1, *weight.shape[-2:]), bias.view(-1, 1, width), [t.view(-1, width) for t in norm])
        )
    return layers
