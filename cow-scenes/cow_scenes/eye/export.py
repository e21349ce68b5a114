"""Writes the network's average as an ONNX file of half precision, as OpenCV and onnxruntime read it."""

from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from .network import Network
from .stage import HEIGHT, WIDTH

LEAST_NUMBERS = 16
"""Smaller constants keep full precision."""


def halve(model: onnx.ModelProto) -> None:
    """Store constants as float16, each with a cast to float32: half the size, and every runtime computes as before."""
    casts = []
    for constant in model.graph.initializer:
        values = numpy_helper.to_array(constant)
        if values.dtype != np.float32 or values.size < LEAST_NUMBERS:
            continue
        name = constant.name
        constant.CopyFrom(numpy_helper.from_array(values.astype(np.float16), f"{name}.half"))
        casts.append(helper.make_node("Cast", [f"{name}.half"], [name], to=TensorProto.FLOAT))
    kept = list(model.graph.node)
    del model.graph.node[:]
    model.graph.node.extend([*casts, *kept])


def export(network: Network, path: Path) -> None:
    """Write the network for pictures of any size whose sides are multiples of 32."""
    picture = torch.zeros(1, 3, HEIGHT, WIDTH)
    sides = {2: "height", 3: "width"}
    path.parent.mkdir(parents=True, exist_ok=True)
    # The exporter by TorchScript folds the batch norms into the convolutions, which OpenCV 4 and 5 read alike.
    torch.onnx.export(
        network.eval().cpu(), (picture,), str(path), input_names=["picture"], output_names=["fine", "coarse"],
        opset_version=17, dynamo=False, dynamic_axes={"picture": sides, "fine": sides, "coarse": sides},
    )  # fmt: skip
    model = onnx.load(path)
    halve(model)
    onnx.checker.check_model(model)
    onnx.save(model, path)
