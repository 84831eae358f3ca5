"""The front door: 2D landmarks in, 3D shapes and cameras out."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from . import baselines, normalizer, shape_prior
from .cameras import nearest_orthonormal, nearness
from .checks import one_of, truth, whole
from .data import Reconstruction
from .gaussian import scales
from .images import Images, read
from .model import Config, DeepNRSfM
from .shape_prior import Prior
from .threads import use_threads
from .training import SCHEDULES, check_training, free_scale, learn_prior, or_warn, read_to_train, train

_CHUNK = 4096  # frames per pass: memory stays flat in the number of frames
_FEW = 2000  # frames, up to which other starts than the network are tried
_MIRROR = np.array([1.0, 1.0, -1.0])  # of shapes and of cameras: the images stay, all depths change their sign
_SURE = 3.0  # standard errors by which hidden points must lie behind, on average, for the hand to be believed
_REFINE_STEPS = 150
_REFINE_RATE = 0.07


def reconstruct(
    W: Any,
    visible: Any = None,
    model: DeepNRSfM | None = None,
    *,
    steps: int | None = None,
    translation: bool | None = None,
    projection: str | None = None,
    refine: bool | str = True,
    adapt: bool = False,
    occlusion: bool = False,
    confidence: Any = None,
    seed: int = 0,
    device: str | torch.device | None = None,
    progress: bool = True,
    checkpoint: str | Path | None = None,
) -> Reconstruction:
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
        A trained network, for instance ``rec.model``: no training takes place, and what only concerns training
        (steps, checkpoint, device) is refused.
    steps : int, optional
        Training steps. Default: those of the default schedule.
    translation : bool, optional
        Train a 4×2 model, which takes the images as they are, uncentred, and finds their translation (chapter
        13). Default: False, or what the given model is.
    projection : "orthographic" or "weak_perspective", optional
        One scale for all frames, or one per frame that goes into the shape; the refinement finds it with the
        camera. Default: orthographic, or what the given model is.
    refine : True, "code" or False
        True: the most probable shape of each frame under the model's shape prior, with the camera fitted
        to it from the network's guess. "code": code and camera fitted to the frame's points by gradient
        descent, dictionaries fixed. False: one forward pass of the network.
    adapt : bool
        Learn a shape prior from these frames, starting from what the model's makes of them, and take it if it
        predicts what it has not seen better than the model's does. It takes longer, and pays for a film of a new
        motion, even one of some ten frames. Without it, each frame is reconstructed on its own. A model without a
        prior always learns it here.
    occlusion : bool
        What is hidden lies behind: of the result and its mirror image, the one in which hidden points are farther from
        the viewer than visible ones, on average over all frames, is returned. For points that the object itself hides;
        where a tracker lost them at random, it says nothing.
    confidence : (F, P), optional
        From 0 to 1: how far to trust each visible point; 0 hides it. A weight in the network's first layer and its
        loss; in the refinement, a point's noise is divided by it. Default: that of the Landmarks, else 1.
    seed, device, progress, checkpoint
        As in `fit`; they concern the training. Inference runs where the model is.

    Returns
    -------
    Reconstruction in the units of W. Its `uncertainty` says how far each point may be off, and for up to 2,000 frames
    that a prior was learned from, its `agreement` how far another start leads elsewhere. No image decides between all
    shapes and their mirror images, unless `occlusion` does; nor, in a collection, whether two of its members are of
    one hand.

    Raises
    ------
    ValueError
        As `fit`; also if `model` was trained for another number of points or another projection, and for arguments
        that contradict each other or cannot act, such as occlusion where nothing is hidden.

    Warns
    -----
    UserWarning
        If no prior could be learned, or if with `occlusion` hidden points lie neither behind nor in front.

    Examples
    --------
    >>> views = nl.datasets.make_views(nl.datasets.make_motion(60))
    >>> nl.reconstruct(views, steps=3, progress=False).shapes.shape
    (60, 31, 3)
    """
    one_of("refine", refine, (True, False, "code"))
    if truth("adapt", adapt) and refine is not True:
        raise ValueError(
            f"adapt=True with refine={refine!r}; the prior that it learns is of use with refine=True only."
        )
    seed = whole("seed", seed, 0)
    occlusion = truth("occlusion", occlusion)
    trained = model is None
    anew = adapt  # the prior is learned here, from these frames
    if model is None:
        plan = SCHEDULES["default"] if steps is None else replace(SCHEDULES["default"], steps=steps)
        device = check_training(seed, device, checkpoint)
        images = read_to_train(W, visible, confidence)
        _check_hidden(images, occlusion)
        config = Config(images.n_points, projection=projection or "orthographic", translation=translation or False)
        anew = adapt or (refine is True and len(images) <= _FEW)
        model = train(
            images, config, plan, seed=seed, device=device, progress=progress, checkpoint=checkpoint,
            with_prior=not (anew and refine is True),
        )  # fmt: skip
    else:
        _check_given(model, steps=steps, checkpoint=checkpoint, device=device)
        _check_same(model, projection=projection, translation=translation)
        images = read(W, visible, confidence, method="reconstruct", every_point=False)
        _check_hidden(images, occlusion)
        if model.config.n_points != images.n_points:
            raise ValueError(f"model was trained for {model.config.n_points} points, but W has {images.n_points}.")
    agreement = None
    with use_threads(1):  # as in `fit`: never slow on a busy machine, and the same result everywhere
        how: Prior | str | None = "code" if refine == "code" else None
        if refine is True:
            how = model.prior
            if anew or (how is None and not trained):  # else `train` has said why there is none
                found = (
                    or_warn(lambda: _learn_prior(model, images, seed)) if trained else _learn_prior(model, images, seed)
                )
                how, agreement = found or (None, None)
            if trained:
                model.prior = how
        S, M, t, doubt = _infer(model, images, how, progress)
    if occlusion and _hidden_in_front(S, M, images.visible):
        S, M = S * _MIRROR, M * _MIRROR[:, None]
        doubt = None if doubt is None else doubt * np.outer(_MIRROR, _MIRROR)
    return images.reconstruction(
        S, M, t, scale=1.0, uncertainty=doubt, agreement=agreement, method="deep_nrsfm", coherence=model.coherence,
        model=model,
    )  # fmt: skip


def _check_given(model: DeepNRSfM, **training: Any) -> None:
    """Refuse what only concerns a training, where there is none."""
    if not isinstance(model, DeepNRSfM):
        raise ValueError(f"model is a {type(model).__name__}; expected a DeepNRSfM, such as rec.model.")
    for name, value in training.items():
        if value is not None:
            raise ValueError(f"{name}={value!r} with a trained model: it concerns the training, and there is none.")


def _check_same(model: DeepNRSfM, **settings: Any) -> None:
    """Refuse settings that a given model does not have."""
    for name, value in settings.items():
        own = getattr(model.config, name)
        if value is not None and value != own:
            raise ValueError(f"model was trained for {name}={own!r}, not {value!r}.")


def _check_hidden(images: Images, occlusion: bool) -> None:
    """Refuse to ask hidden points where there are none."""
    if occlusion and images.visible.all():
        raise ValueError("occlusion=True needs hidden points, but every point is visible.")


def _hidden_in_front(S: np.ndarray, M: np.ndarray, visible: np.ndarray) -> bool:
    """Whether hidden points lie nearer to the viewer than visible ones, in the mean over the frames that hide some."""
    some = ~visible.all(1)
    depth, hidden = nearness(S[some], M[some]), ~visible[some]
    size = np.sqrt(np.square(S[some]).sum(2).mean(1))
    depth = depth / size[:, None]
    nearer = (depth * hidden).sum(1) / hidden.sum(1) - (depth * ~hidden).sum(1) / (~hidden).sum(1)
    error = nearer.std() / math.sqrt(len(nearer))
    if abs(nearer.mean()) < _SURE * error:
        warnings.warn(
            f"hidden points lie neither behind nor in front of visible ones (by {-nearer.mean():.3f} ± {error:.3f} of "
            "the object's size), so that which mirror image is right remains open.",
            stacklevel=3,
        )
    return float(nearer.mean()) > 0


def _learn_prior(model: DeepNRSfM, images: Images, seed: int) -> tuple[Prior, float | None]:
    """The shape prior of these frames, or the model's own, if it has one that serves them better; and the agreement.

    What the network makes of them is where it starts, refined by the model's prior if there is one. Of few frames
    classical methods are tried, too: the network may be wrong.
    """
    X, mean, weight = images.tensors(device=model.device)
    image, X, _ = model.normalizer.normalize(X, mean, weight)
    prior, free = model.prior, free_scale(model)
    if prior is None and len(images) > _FEW:
        return learn_prior(model, image, X.cpu(), weight.cpu(), torch.Generator().manual_seed(seed)), None
    with torch.no_grad():
        _, S, M = model.lift(image)
    X, weight, image, S, M = X.cpu(), weight.cpu(), image.double().cpu(), S.double().cpu(), M.double().cpu()
    if prior is not None:
        S, M = shape_prior.apply(prior, X, weight, M)
    starts, agreement = [(S, M)], None
    if len(images) <= _FEW:
        # In single precision: the last digits of another unit of length are gone, which can decide between two minima.
        for other_S, other_M in baselines.starts(image.float().double().numpy(), seed):
            # Into the network's world, so that its cameras of other frames remain a start for this prior.
            U, _, Vh = torch.linalg.svd(torch.einsum("fij,fkj->ik", M, torch.as_tensor(other_M)))
            starts.append((torch.as_tensor(other_S) @ (U @ Vh).mT, U @ Vh @ torch.as_tensor(other_M)))
        best, agreement = shape_prior.choose(X, weight, starts, free_scale=free)
        S, M = starts[best]
    if prior is not None:
        return shape_prior.adapt(prior, X, weight, S, M), agreement
    return shape_prior.learn(X, weight, S, M, free_scale=free), agreement


def _infer(
    model: DeepNRSfM, images: Images, how: Prior | str | None, progress: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """Shapes, cameras, translations and uncertainty of all frames, in the user's units, chunk by chunk."""
    F, P = images.weight.shape
    S, M, t, doubt = np.empty((F, P, 3)), np.empty((F, 3, 2)), np.empty((F, 2)), None
    if how is not None and not isinstance(how, str):
        doubt = np.empty((F, P, 3, 3))
    with tqdm(total=F, desc="refining", unit="frame", disable=not (progress and how), mininterval=0.5) as bar:
        for first in range(0, F, _CHUNK):
            part = slice(first, first + _CHUNK)
            S[part], M[part], t[part], each = infer(model, *images.tensors(part, model.device), how)
            if doubt is not None:
                doubt[part] = each
            bar.update(len(S[part]))
    return S, M, t, doubt


def infer(
    model: DeepNRSfM,
    W: Tensor,
    mean: Tensor,
    weight: Tensor,
    how: Prior | str | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """What a trained network makes of some frames, and the refinement of it; in double precision at the end.

    Parameters
    ----------
    model : DeepNRSfM
    W, mean, weight : double tensors (B, P, 2), (B, 2) and (B, P) where the model is
        Centred image points, what was subtracted, and how much each point counts.
    how : shape prior (as `shape_prior.learn` returns it), "code" or None
        How to go on from the network's guess.

    Returns
    -------
    S (B, P, 3) centred, M (B, 3, 2), t (B, 2) beyond the mean, and, from a shape prior, covariances (B, P, 3, 3) of the
    points: tensors on the CPU in the units of W.
    """
    image, X, unit = model.normalizer.normalize(W, mean, weight)
    with torch.no_grad():
        psi, S, M = model.lift(image)
    doubt = None
    if how is not None and not isinstance(how, str):
        S, M = shape_prior.apply(how, X.cpu(), weight.cpu(), M.cpu())
        doubt = shape_prior.uncertainty(how, X.cpu(), weight.cpu(), S, M) * unit.cpu()[:, None, None, None] ** 2
        S = S * scales(M)[:, None, None]  # 1, or the frame's own, which goes into the shape
    elif how == "code":
        psi, M = _refine_code(model, X.to(model.dtype), weight, psi, M)
        with torch.no_grad():
            S = model.decode(psi)
    # A float32 camera is orthonormal to 1e-7; once more in double precision costs nothing.
    S, M = S.double().cpu(), nearest_orthonormal(M.detach().double().cpu())
    S = (S - S.mean(1, keepdim=True)) * unit[:, None, None].cpu()
    return S, M, normalizer.weighted_mean(W.cpu() - S @ M, weight.cpu()), doubt


def _refine_code(model: DeepNRSfM, X: Tensor, weight: Tensor, psi: Tensor, M: Tensor) -> tuple[Tensor, Tensor]:
    """Code (B, K) and camera (B, 3, 2) after Adam on each frame's reprojection error, translations at their best."""
    weight = weight.to(X.dtype)
    unit = psi.abs().mean(1, keepdim=True).clamp(min=1e-6)  # codes live on the network's own scale
    code, camera = (psi / unit).clone().requires_grad_(), M.clone().requires_grad_()
    optimizer = torch.optim.Adam([code, camera], _REFINE_RATE)
    for step in range(_REFINE_STEPS):
        for group in optimizer.param_groups:
            group["lr"] = _REFINE_RATE * (1 - step / _REFINE_STEPS)
        with torch.enable_grad():
            rest, _ = normalizer.center(X - model.decode(code * unit) @ nearest_orthonormal(camera), weight)
            # Each frame on its own: the sum's gradient for one frame does not see the others.
            objective = (rest.square().sum(2) * weight).sum()
            code.grad, camera.grad = torch.autograd.grad(objective, [code, camera])
        optimizer.step()
    with torch.no_grad():
        return code * unit, nearest_orthonormal(camera)
