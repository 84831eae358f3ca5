"""Networks in files: a configuration and arrays, never code."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch


def save(path: str | Path, config: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Path:
    """Write a configuration and arrays; returns the path."""
    path = Path(path)
    torch.save({"config": dict(config), "arrays": {key: torch.as_tensor(a) for key, a in arrays.items()}}, path)
    return path


def load(path: str | Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """What `save` wrote.

    Raises FileNotFoundError if there is no such file, ValueError if it is something else.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file.")
    try:
        saved = torch.load(path, weights_only=True, map_location="cpu")
        return saved["config"], saved["arrays"]
    except (RuntimeError, KeyError, TypeError, EOFError, OSError, pickle.UnpicklingError, BadZipFile) as error:
        raise ValueError(f"not a saved network, or a broken one ({type(error).__name__}).") from None


def to_onnx(net: torch.nn.Module, W: torch.Tensor, path: str | Path) -> Path:
    """Write a module's forward pass for any number of frames; W (B, P, 2) is an example. Returns the path."""
    visible = torch.ones(W.shape[:2], dtype=torch.bool, device=W.device)
    frames = {0: torch.export.Dim("frames", min=1)}
    program = torch.export.export(net, (W, visible), dynamic_shapes=(frames, frames))
    names = {"input_names": ["W", "visible"], "output_names": ["S", "M", "t"]}
    torch.onnx.export(program, dynamo=True, verbose=False, **names).save(str(path))
    return Path(path)
