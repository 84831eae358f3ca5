"""The network of the paper: a block-sparse encoder, a camera, and a decoder with the same dictionaries.

Shapes in comments: B frames, P points, K_i atoms of dictionary i, N dictionaries.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from . import normalizer, weights
from .cameras import nearest_orthonormal
from .checks import check_shape, one_of, truth, whole
from .gaussian import Gaussian
from .normalizer import Normalizer
from .shape_prior import Prior
from .sparse_coding import mutual_coherence

_FOUND = ("scale", "origin", "covariance")  # fields of a `Normalizer` that training finds
_OF_A_GAUSSIAN = ("mean", "covariance", "noise", "share", "spread")
EPSILON = 0.05  # ε of the 4×2 model: every entry of the row of translations in D₁, up to its sign


@dataclass(frozen=True)
class Config:
    """Everything that decides the form of a network; the defaults are those of the authors' code for motion capture.

    Parameters
    ----------
    n_points : int
        P.
    n_dictionaries : int
        N, the depth.
    first_atoms, last_atoms : int
        K₁ and K_N; the widths between are ``linspace(K₁, K_N, N)`` cut to integers.
    beta : "full" or "shared"
        How the sparse code is read off the last blocks. "shared": one weight per entry of a block
        (paper, eq. 24). "full": a linear map of all entries of all blocks (the authors' code).
    threshold : "relu" or "soft"
        η of every layer. "relu": max(x − b, 0), codes of at least zero and a free b, as the paper runs
        it. "soft": the soft threshold, blocks of both signs and b ≥ 0, as the paper derives it; the
        code is then read off in magnitude, for a reason that chapter 09 gives.
    output_bias : bool
        Add a learned mean shape S̄ (the authors' code) to the last, linear layer.
    projection : "orthographic" or "weak_perspective"
        One scale for the whole set, or one per frame that goes into the shape.
    fill : "likely", "zero" or "scaled"
        What the encoder gets for a hidden point: its likely place, given the visible ones (chapter 11); zero, as
        in the paper; or zero, and the visible points times their weights, scaled up so that these sum to P.
    translation : bool
        The 4×2 model: images are not centred, and a fourth row in every block takes the translation
        (paper, section on scale and translation; chapter 13).

    Raises
    ------
    ValueError
        If a value is outside its range.

    Examples
    --------
    >>> nl.Config(n_points=31, n_dictionaries=3).widths
    [125, 67, 10]
    """

    n_points: int
    n_dictionaries: int = 12
    first_atoms: int = 125
    last_atoms: int = 10
    beta: str = "full"
    threshold: str = "relu"
    output_bias: bool = True
    projection: str = "orthographic"
    fill: str = "likely"
    translation: bool = False

    def __post_init__(self) -> None:
        for key, least in [("n_points", 3), ("n_dictionaries", 1), ("first_atoms", 2), ("last_atoms", 2)]:
            # A NumPy integer becomes an int, which can be written as JSON.
            object.__setattr__(self, key, whole(key, getattr(self, key), least))
        if self.first_atoms < self.last_atoms:
            raise ValueError(
                f"first_atoms={self.first_atoms}, last_atoms={self.last_atoms}; "
                "expected first_atoms >= last_atoms >= 2."
            )
        for key, options in [
            ("beta", ("full", "shared")),
            ("threshold", ("relu", "soft")),
            ("projection", ("orthographic", "weak_perspective")),
            ("fill", ("likely", "zero", "scaled")),
        ]:
            one_of(key, getattr(self, key), options)
        for key in ("output_bias", "translation"):
            object.__setattr__(self, key, truth(key, getattr(self, key)))

    @property
    def widths(self) -> list[int]:
        """[K₁, …, K_N]."""
        return np.linspace(self.first_atoms, self.last_atoms, self.n_dictionaries).astype(int).tolist()

    @property
    def block_rows(self) -> int:
        """3, or 4 with translations: blocks are 3×2 or 4×2."""
        return 4 if self.translation else 3


class DeepNRSfM(nn.Module):
    """Deep NRSfM with 3×2 blocks: 2D landmarks in, 3D shapes and cameras out (arXiv:1907.13123).

    ``DeepNRSfM(n_points=31)`` takes the defaults, ``DeepNRSfM(Config(...))`` any setting. The
    parameters carry the names of the paper: `D` (list of dictionaries), `encoder_threshold`,
    `decoder_threshold`, `beta`, `gamma`, `output_bias`. The weights start Glorot-uniform as in the authors' code,
    drawn from `generator`; thresholds and S̄ start at zero.

    What `fit` finds besides is kept beside the parameters: `normalizer`, the way between image units and the
    network's, and `prior`, the shape prior, or None.

    Examples
    --------
    >>> S, M, t = nl.DeepNRSfM(n_points=8)(np.random.default_rng(0).normal(size=(5, 8, 2)))
    >>> S.shape, M.shape, t.shape
    (torch.Size([5, 8, 3]), torch.Size([5, 3, 2]), torch.Size([5, 2]))
    """

    normalizer: Normalizer
    prior: Prior | None

    def __init__(
        self,
        config: Config | None = None,
        *,
        n_points: int | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        if config is None:
            if n_points is None:
                raise ValueError("DeepNRSfM needs n_points or a Config.")
            config = Config(n_points)
        if not isinstance(config, Config):
            raise ValueError(f"config is {config!r}; expected a Config, or n_points=… by name.")
        self.config = config
        P, K = config.n_points, config.widths
        self.D = nn.ParameterList(
            [nn.Parameter(torch.empty(K[0], P, 3))] + [nn.Parameter(torch.empty(a, b)) for a, b in pairwise(K)]
        )
        self.encoder_threshold = nn.ParameterList([nn.Parameter(torch.zeros(k)) for k in K])
        self.decoder_threshold = nn.ParameterList([nn.Parameter(torch.zeros(k)) for k in K[:-1]])
        entries = 2 * config.block_rows  # of a block
        self.beta = nn.Parameter(torch.empty(*(entries * K[-1], K[-1]) if config.beta == "full" else (entries,)))
        self.gamma = nn.Parameter(torch.empty(K[-1]))
        self.output_bias = nn.Parameter(torch.zeros(P, 3), requires_grad=config.output_bias)
        self.normalizer = Normalizer(
            projection=config.projection,
            fill=config.fill,
            translation=config.translation,
            scale=1.0,
            origin=torch.zeros(2, dtype=torch.float64),
            covariance=torch.eye(P, dtype=torch.float64) - 1 / P,
        )
        self.prior = None
        self._draw_weights(generator)

    def _draw_weights(self, generator: torch.Generator | None) -> None:
        def glorot(parameter: Tensor, fan_in: int, fan_out: int) -> None:
            limit = (6 / (fan_in + fan_out)) ** 0.5
            nn.init.uniform_(parameter, -limit, limit, generator=generator)

        glorot(self.D[0], 3 * self.config.first_atoms, 3 * self.config.n_points)
        for D in list(self.D)[1:]:
            glorot(D, *D.shape)
        last = self.config.last_atoms
        entries = 2 * self.config.block_rows
        glorot(self.beta, entries * last if self.config.beta == "full" else entries, last)
        glorot(self.gamma, last, 1)

    @property
    def coherence(self) -> float:
        """Mutual coherence of the last dictionary, a quality measure that needs no truth (chapter 10a)."""
        D = self.D[-1]
        return mutual_coherence(D if D.ndim == 2 else D.flatten(1).T)

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        return self.gamma.device

    @property
    def dtype(self) -> torch.dtype:
        """The type of the parameters; images come in and go out in their own."""
        return self.gamma.dtype

    def encode(self, image: Tensor) -> Tensor:
        """Block sparse code of images (B, P, 2) as `normalize` makes them: Psi_N (B, 2, 3, K_N); 4×2 (B, 2, 4, K_N).

        One step of block ISTA per layer. The columns of a block come before its rows here, so that
        every layer is one matrix product over the flattened batch (chapter 06).
        """
        B, P, _ = image.shape
        n = 2 * self.config.block_rows * B
        Z = image.mT.reshape(2 * B, P) @ self.first_dictionary()  # (2B, rows K₁)
        Z = self._threshold(Z.view(n, -1), self.encoder_threshold[0])  # (n, K₁)
        for D, b in zip(list(self.D)[1:], list(self.encoder_threshold)[1:], strict=True):
            Z = self._threshold(Z @ D, b)  # (n, K_i)
        return Z.view(B, 2, self.config.block_rows, -1)

    def first_dictionary(self) -> Tensor:
        """D₁ as the first layer multiplies with it: (P, 3 K₁), or (P, 4 K₁) with the row of translations.

        In the 4×2 model every atom is centred, so that rows 1 to 3 do not see the translation of a complete
        image, and the fourth sees nothing else. Its signs alternate: with one sign and ReLU, a negative
        translation would vanish in all blocks.
        """
        D1 = self.D[0].permute(1, 2, 0)  # (P, 3, K₁)
        if self.config.translation:
            D1 = D1 - D1.mean(0)
            sign = 1.0 - 2 * (torch.arange(D1.shape[2], device=D1.device) % 2)
            D1 = torch.cat([D1, (EPSILON * sign).to(D1).expand(len(D1), 1, -1)], 1)
        return D1.reshape(len(D1), -1)

    def _threshold(self, x: Tensor, b: Tensor) -> Tensor:
        """η(x; b), one threshold per atom."""
        above = torch.relu(x - b)
        return above if self.config.threshold == "relu" else above - torch.relu(-x - b)

    def bottleneck(self, Psi: Tensor) -> tuple[Tensor, Tensor]:
        """Sparse code and camera of Psi_N (B, 2, rows, K): psi (B, K) and M (B, 3, 2), orthonormal."""
        B, _, rows, K = Psi.shape
        full = self.config.beta == "full"
        psi = Psi.reshape(B, -1) @ self.beta if full else self.beta @ Psi.reshape(B, 2 * rows, K)
        if self.config.threshold == "soft":
            # The picture turned by 180°, −W, shows the same shape. With odd thresholds every block changes
            # its sign, and so does M, as it must; the code must not (chapter 09).
            psi = psi.abs()
        return psi, nearest_orthonormal((Psi @ self.gamma)[:, :, :3].mT)

    def decode(self, psi: Tensor) -> Tensor:
        """Shape of a sparse code, in normalised units: (B, K_N) -> (B, P, 3)."""
        for D, b in zip(list(self.D)[:0:-1], list(self.decoder_threshold)[::-1], strict=True):
            psi = self._threshold(psi @ D.mT, b)  # (B, K_{i-1})
        S = psi @ self.D[0].flatten(1)  # (B, 3P)
        return S.view(-1, *self.output_bias.shape) + self.output_bias

    def lift(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Code, shape and camera of normalised images, in the network's units.

        Parameters
        ----------
        image : (B, P, 2) tensor, as `normalize` makes it; cast to the parameters' type

        Returns
        -------
        psi : (B, K_N); S : (B, P, 3), not centred; M : (B, 3, 2), orthonormal columns
        """
        psi, M = self.bottleneck(self.encode(image.to(self.dtype)))
        return psi, self.decode(psi), M

    def normalize(self, W: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`Normalizer.normalize` of image points as they are, (B, P, 2), with weights (B, P): image, X and unit."""
        return self.normalizer.normalize(*normalizer.center(W, weight), weight)

    def forward(self, W: Any, visible: Any = None, confidence: Any = None) -> tuple[Tensor, Tensor, Tensor]:
        """Shapes, cameras and translations of image points.

        Parameters
        ----------
        W : (B, P, 2) tensor or array in image coordinates; hidden points may be NaN
        visible : (B, P) bool tensor or array, optional
        confidence : (B, P), optional
            From 0 to 1, how far to trust a visible point; 0 hides it.

        Returns
        -------
        S : (B, P, 3), centred over the points; M : (B, 3, 2); t : (B, 2)
            In the units and the type of W, where the network is; ``S @ M + t[:, None]`` reprojects.

        Raises
        ------
        ValueError
            For arrays of wrong shape or range, or visible points that are not finite.
        """
        W, weight = (W, visible) if torch.compiler.is_exporting() else self._parse(W, visible, confidence)
        X, mean = normalizer.center(W.double(), weight)
        image, _, unit = self.normalizer.normalize(X, mean, weight)
        _, S, M = self.lift(image)
        S, M = S.double(), M.double()
        S = (S - S.mean(1, keepdim=True)) * unit[:, None, None]
        t = mean + normalizer.weighted_mean(X - S @ M, weight)  # the best t in closed form
        return S.to(W.dtype), M.to(W.dtype), t.to(W.dtype)

    def _parse(self, W: Any, visible: Any, confidence: Any) -> tuple[Tensor, Tensor]:
        """W and the points' weights as tensors where the network is; unlike `images.parse`, gradients pass through."""
        W = torch.as_tensor(W, device=self.device)
        W = W if W.is_floating_point() else W.double()
        P = self.config.n_points
        if W.ndim != 3 or tuple(W.shape[1:]) != (P, 2):
            raise ValueError(f"W has shape {tuple(W.shape)}; expected (B, {P}, 2), as the network has {P} points.")
        weight = torch.ones(W.shape[:2], dtype=torch.bool, device=self.device)
        for name, given in [("visible", visible), ("confidence", confidence)]:
            if given is not None:
                given = torch.as_tensor(given, device=self.device)
                check_shape(name, given, tuple(W.shape[:2]))
                allowed = (given == 0) | (given == 1) if name == "visible" else (given >= 0) & (given <= 1)
                if not allowed.all():
                    expected = "truth values; weights are given as confidence" if name == "visible" else "0 to 1"
                    raise ValueError(f"{name} holds {given[~allowed][0].item():g}; expected {expected}.")
                weight = weight * given
        if not torch.isfinite(W).all(2)[weight > 0].all():
            raise ValueError("W has visible points that are NaN or infinite; mark missing points as False in visible.")
        return W, weight

    def save(self, path: str | Path) -> Path:
        """Write configuration, weights, normaliser and prior to one file that holds no code; returns its path."""
        return weights.save(path, *self.to_arrays())

    @classmethod
    def load(cls, path: str | Path) -> DeepNRSfM:
        """The network that `save` wrote, on the CPU and in evaluation mode.

        Raises FileNotFoundError if there is no such file, ValueError if it is not a saved network.
        """
        try:
            return cls.from_arrays(*weights.load(path))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    def to_onnx(self, path: str | Path) -> Path:
        """Write the forward pass as ONNX, for any number of frames: W and visible in; S, M and t out.

        Needs the packages onnx and onnxscript (``pip install nrsfm-lite[onnx]``). Returns the path.
        """
        W = torch.zeros(2, self.config.n_points, 2, dtype=self.dtype, device=self.device)
        W[:, 0, 0], W[:, 1, 1] = 1, 1  # any two frames that are not a point
        return weights.to_onnx(self, W, path)

    def get_extra_state(self) -> dict[str, Tensor]:
        """Normaliser and prior, of which only what is in use: with the parameters, all of `state_dict`."""
        state = {
            f"normalizer/{key}": torch.as_tensor(getattr(self.normalizer, key), dtype=torch.float64) for key in _FOUND
        }
        for i, gaussian in enumerate(self.prior or ()):
            for key in _OF_A_GAUSSIAN:
                state[f"prior/{i}/{key}"] = torch.as_tensor(getattr(gaussian, key), dtype=torch.float64)
        return state

    def set_extra_state(self, state: Mapping[str, Tensor]) -> None:
        """Take over what `get_extra_state` gave."""
        scale, origin, covariance = (state[f"normalizer/{key}"] for key in _FOUND)
        self.normalizer = replace(self.normalizer, scale=float(scale), origin=origin, covariance=covariance)
        n = len({key.split("/")[1] for key in state if key.startswith("prior/")})
        parts = [{key: state[f"prior/{i}/{key}"] for key in _OF_A_GAUSSIAN} for i in range(n)]
        scalars = _OF_A_GAUSSIAN[2:]
        self.prior = (
            tuple(Gaussian(p["mean"], p["covariance"], **{key: float(p[key]) for key in scalars}) for p in parts)
            or None
        )

    def to_arrays(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """(config, arrays) as a dict and a dict of NumPy arrays: all that `from_arrays` needs."""
        state = self.state_dict()
        extra = state.pop("_extra_state")
        return asdict(self.config), {key: value.detach().cpu().numpy() for key, value in (state | extra).items()}

    @classmethod
    def from_arrays(cls, config: Mapping[str, Any], arrays: Mapping[str, Any]) -> DeepNRSfM:
        """The network that `to_arrays` took apart, in evaluation mode.

        Raises ValueError if something is missing or does not fit.
        """
        try:
            net = cls(Config(**config), generator=torch.Generator())
            tensors = {key: torch.as_tensor(value) for key, value in arrays.items()}
            extra = {key: tensors.pop(key) for key in list(tensors) if "/" in key}
            net.to(tensors["gamma"].dtype).load_state_dict(tensors | {"_extra_state": extra})
        except (KeyError, TypeError, RuntimeError, ValueError):
            raise ValueError("the network in it is incomplete or of another version.") from None
        return net.eval()
