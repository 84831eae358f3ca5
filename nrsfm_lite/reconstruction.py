"""The front door: 2D landmarks in, 3D shapes and cameras out."""

import numpy as np
import torch

from . import preprocessing, shape_prior
from .cameras import nearest_orthonormal
from .data import Landmarks, Reconstruction, as_points, as_weights
from .model import Config
from .threads import use_threads
from .training import fit, learn_prior

_CHUNK = 4096  # frames per pass: memory stays flat in the number of frames
_REFINE_STEPS = 150
_REFINE_RATE = 0.07


def reconstruct(
    W,
    visible=None,
    model=None,
    steps=None,
    translation=False,
    projection="orthographic",
    refine=True,
    adapt=False,
    confidence=None,
    seed=0,
    device=None,
    progress=True,
    checkpoint=None,
):
    """3D shapes and cameras of 2D landmarks, without any 3D supervision.

    Trains a network on the frames (or takes a trained one), infers every frame's shape and camera, and
    refines both with the prior over shapes that was learned with the network.

    Parameters
    ----------
    W : Landmarks, or (F, P, 2) array or tensor
        Image points, in any unit; every frame shows the same P points in the same order.
    visible : (F, P) bool, optional
        False where a point is missing. Default: that of the Landmarks, else everything.
    model : DeepNRSfM, optional
        A trained network, for instance ``rec.model``: no training takes place.
    steps : int, optional
        Training steps. Default: those of the default schedule.
    translation : bool
        Train a 4×2 model, which takes the images as they are, uncentred, and finds their translation (chapter
        13). A given model is what it is.
    projection : "orthographic" or "weak_perspective"
        One scale for all frames, or one per frame that goes into the shape.
    refine : True, "code" or False
        True: the most probable shape of each frame under the model's shape prior, with the camera fitted
        to it from the network's guess. "code": code and camera fitted to the frame's points by gradient
        descent, dictionaries fixed. False: one forward pass of the network.
    adapt : bool
        Learn the shape prior from these frames instead of taking the model's; it pays for new motions of
        some hundred frames or more. Without it, each frame is reconstructed on its own. A model without
        a prior always learns it here.
    confidence : (F, P), optional
        From 0 to 1: how far to trust each visible point. A weight in the network's first layer and its loss; in
        the refinement, a point's noise is divided by it. Default: that of the Landmarks, else 1.
    seed, device, progress, checkpoint
        As in `fit`; they concern the training. Inference runs where the model is.

    Returns
    -------
    Reconstruction in the units of W.

    Raises
    ------
    ValueError
        As `fit`; also if `model` was trained for another number of points or another projection.
    """
    if refine not in (True, False, "code"):
        raise ValueError(f"refine={refine!r}; expected True, False or 'code'.")
    weight = torch.as_tensor(as_weights(W, visible, confidence))
    W, visible, names, edges = as_points(W, visible)
    W = torch.as_tensor(W)
    if model is None:
        config = Config(n_points=W.shape[1], projection=projection, translation=translation)
        model = fit(
            Landmarks(W, visible, weight, names=names, edges=edges), config=config, steps=steps, seed=seed,
            device=device, progress=progress, checkpoint=checkpoint,
        )  # fmt: skip
    elif model.config.n_points != W.shape[1]:
        raise ValueError(f"model was trained for {model.config.n_points} points, but W has {W.shape[1]}.")
    elif model.config.projection != projection:
        raise ValueError(f"model was trained for projection={model.config.projection!r}, not {projection!r}.")
    else:
        preprocessing.check_extent(W, weight)  # `fit` has checked its own frames
    with use_threads(1):  # as in `fit`: never slow on a busy machine, and the same result everywhere
        if refine and refine != "code":
            refine = None if adapt else model.prior
            if refine is None:
                device = model.scale.device
                image, X, _ = model.normalize(W.to(device), weight.to(device))
                refine = learn_prior(model, image, X.cpu(), weight, torch.Generator().manual_seed(seed))
        F, P, _ = W.shape
        S, M, t = np.empty((F, P, 3)), np.empty((F, 3, 2)), np.empty((F, 2))
        for first in range(0, F, _CHUNK):
            part = slice(first, first + _CHUNK)
            S[part], M[part], t[part] = infer(model, W[part], weight[part], refine)
    return Reconstruction(
        shapes=S,
        cameras=M,
        translations=t,
        visible=visible,
        names=names,
        edges=edges,
        coherence=model.coherence,
        method="deep_nrsfm",
        model=model,
    )


def infer(model, W, visible, refine=False):
    """Shapes, cameras and translations of some frames by a trained network, in double precision at the end.

    Parameters
    ----------
    model : DeepNRSfM
    W, visible : tensors (B, P, 2) and (B, P)
        `visible` is bool or holds weights from 0 to 1.
    refine : shape prior (as `shape_prior.learn` returns it), "code" or False
        How to go on from the network's guess.

    Returns
    -------
    S (B, P, 3) centred, M (B, 3, 2), t (B, 2): tensors in the units of W.
    """
    device = model.scale.device
    image, X, scale = model.normalize(W.to(device), visible.to(device))
    with torch.no_grad():
        psi, M = model.bottleneck(model.encode(image.to(model.scale.dtype)))
    if isinstance(refine, tuple):
        S, M = shape_prior.apply(refine, X.cpu(), visible, M.cpu())
    else:
        if refine == "code":
            psi, M = _refine_code(model, X.to(model.scale.dtype), visible.to(device), psi, M)
        with torch.no_grad():
            S = model.decode(psi).double().cpu()
    # A float32 camera is orthonormal to 1e-7; once more in double precision costs nothing.
    M = nearest_orthonormal(M.detach().double().cpu())
    S = (S - S.mean(1, keepdim=True)) * scale[:, None, None].double().cpu()
    return S, M, preprocessing.visible_mean(W - S @ M, visible)


def _refine_code(model, X, visible, psi, M):
    """Code (B, K) and camera (B, 3, 2) after Adam on each frame's reprojection error, translations at their best."""
    weight = visible.to(X.dtype)
    unit = psi.abs().mean(1, keepdim=True).clamp(min=1e-6)  # codes live on the network's own scale
    code, camera = (psi / unit).clone().requires_grad_(), M.clone().requires_grad_()
    optimizer = torch.optim.Adam([code, camera], _REFINE_RATE)
    for step in range(_REFINE_STEPS):
        for group in optimizer.param_groups:
            group["lr"] = _REFINE_RATE * (1 - step / _REFINE_STEPS)
        with torch.enable_grad():
            residual, _ = preprocessing.center(X - model.decode(code * unit) @ nearest_orthonormal(camera), weight)
            # Each frame on its own: the sum's gradient for one frame does not see the others.
            objective = (residual.square().sum(2) * weight).sum()
            code.grad, camera.grad = torch.autograd.grad(objective, [code, camera])
        optimizer.step()
    with torch.no_grad():
        return code * unit, nearest_orthonormal(camera)
