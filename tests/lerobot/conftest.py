"""Lets torchvision load beside another torch than its own.

`make test-lerobot` says why.

lerobot 0.4.4 imports torchvision for pictures, which our steps hand on. Its compiled part does not
load there, and one registration of its Python part asks for an operator of it.
"""

from importlib.metadata import version

import torch

if not version("torch").startswith("2.10."):
    _LIBRARY = torch.library.Library("torchvision", "DEF")
    _LIBRARY.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
