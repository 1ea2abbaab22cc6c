"""A policy's network leaves Python with the numbers that it has there, by every exporter of torch."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from torchrl_tsallis.modules import Linear, NormalHead, RMSNorm, Squish, make_policy, squareplus

# torch 2.13: its exporters warn of each other, of themselves, and of torchvision
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning")


def policy():
    torch.manual_seed(0)
    return make_policy(3, 2, hidden=(8, 8)).module[0].module.eval()


def exported(net, x, folder):
    program = torch.export.export(net, (x,), dynamic_shapes=({0: torch.export.Dim("batch")},))
    torch.export.save(program, folder / "net.pt2")
    return torch.export.load(folder / "net.pt2").module()


def traced(net, x, folder):
    torch.jit.trace(net, x).save(folder / "net.pt")
    return torch.jit.load(folder / "net.pt")


def onnx(dynamo):
    def export(net, x, folder):
        pytest.importorskip("onnxscript")
        onnxruntime = pytest.importorskip("onnxruntime")
        file = str(folder / "net.onnx")
        shapes = {"dynamic_shapes": ({0: torch.export.Dim("batch")},)} if dynamo else {"dynamic_axes": {"x": {0: "b"}}}
        torch.onnx.export(net, (x,), file, dynamo=dynamo, input_names=["x"], verbose=False, **shapes)
        session = onnxruntime.InferenceSession(file)
        return lambda z: [torch.from_numpy(y) for y in session.run(None, {"x": z.numpy()})]

    return export


EXPORTERS = {"export": exported, "trace": traced, "onnx": onnx(True), "legacy_onnx": onnx(False)}


@pytest.mark.parametrize("exporter", EXPORTERS)
def test_the_exported_policy_gives_the_same_numbers_for_any_batch(exporter, tmp_path):
    net, x = policy(), torch.randn(4, 3)
    run = EXPORTERS[exporter](net, x, tmp_path)
    for z in (x, torch.randn(1, 3), 100 * torch.randn(7, 3), torch.zeros(2, 3)):
        for got, expected in zip(run(z), net(z), strict=True):
            torch.testing.assert_close(got, expected.detach(), rtol=1e-5, atol=1e-5)


class _Squareplus(nn.Module):
    def forward(self, x):
        return squareplus(x)


@pytest.mark.parametrize("exporter", ["export", "trace"])
@pytest.mark.parametrize(
    "module", [RMSNorm(3), RMSNorm(3, eps=0.1), Squish(), _Squareplus(), Linear(3, 5),
               nn.Sequential(Linear(3, 4), NormalHead(1e-3))],
    ids=lambda m: type(m).__name__,
)  # fmt: skip
def test_each_module_can_be_exported_alone(exporter, module, tmp_path):
    run = EXPORTERS[exporter](module, torch.randn(4, 3), tmp_path)
    z = torch.randn(2, 3)
    torch.testing.assert_close(run(z), module(z))


def test_half_precision_is_exported_with_its_float32_inside():
    module = RMSNorm(8).bfloat16()
    x = (0.01 * torch.randn(4, 8)).bfloat16()
    torch.testing.assert_close(torch.jit.trace(module, x)(x), nn.RMSNorm(8).bfloat16()(x))
