"""Exported to ONNX, for any batch, layers give the same results."""

import numpy as np
import pytest
import torch
from torch import nn

import curvireg_torch as cr

onnxruntime = pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript")

LAYERS = {
    "gradient": cr.ImageGradient(),
    "hog": nn.Sequential(cr.ImageGradient(), cr.HOG()),
    "depth": cr.DepthCurvilinearSaliency(),
    "focus": cr.MultiScaleFocusCurves(),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(LAYERS))
def test_layers_in_onnx_runtime(name, tmp_path):
    layer = LAYERS[name].eval()
    generator = torch.Generator().manual_seed(0)
    any_batch = {0: torch.export.Dim("batch", min=1, max=64)}
    example = torch.rand(2, 1, 64, 64, generator=generator)
    path = tmp_path / "layer.onnx"
    torch.onnx.export(
        layer, (example,), path, dynamo=True, dynamic_shapes=(any_batch,), verbose=False
    )
    session = onnxruntime.InferenceSession(path)
    images = torch.rand(5, 1, 64, 64, generator=generator)
    (found,) = session.run(None, {session.get_inputs()[0].name: images.numpy()})
    np.testing.assert_allclose(found, layer(images).numpy(), atol=1e-6)
