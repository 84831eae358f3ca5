"""The network of the paper: a block-sparse encoder, a camera, and a decoder with the same dictionaries.

Shapes in comments: B frames, P points, K_i atoms of dictionary i, N dictionaries.
"""

from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import nn

from . import completion, data, preprocessing
from .cameras import nearest_orthonormal
from .shape_prior import KINDS, Gaussian
from .sparse_coding import mutual_coherence

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

    def __post_init__(self):
        for key in ("n_points", "n_dictionaries", "first_atoms", "last_atoms"):
            object.__setattr__(self, key, int(getattr(self, key)))  # NumPy integers cannot be written as JSON
        if self.n_points < 3:
            raise ValueError(f"n_points is {self.n_points}; a shape needs at least 3 points.")
        if self.n_dictionaries < 1:
            raise ValueError(f"n_dictionaries is {self.n_dictionaries}; expected at least 1.")
        if not self.first_atoms >= self.last_atoms >= 2:
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
            if getattr(self, key) not in options:
                raise ValueError(f"{key}={getattr(self, key)!r}; expected one of {', '.join(options)}.")

    @property
    def widths(self):
        """[K₁, …, K_N]."""
        return np.linspace(self.first_atoms, self.last_atoms, self.n_dictionaries).astype(int).tolist()

    @property
    def block_rows(self):
        """3, or 4 with translations: blocks are 3×2 or 4×2."""
        return 4 if self.translation else 3


class DeepNRSfM(nn.Module):
    """Deep NRSfM with 3×2 blocks: 2D landmarks in, 3D shapes and cameras out.

    ``DeepNRSfM(n_points=31)`` takes the defaults, ``DeepNRSfM(Config(...))`` any setting. The
    parameters carry the names of the paper: `D` (list of dictionaries), `encoder_threshold`,
    `decoder_threshold`, `beta`, `gamma`, `output_bias`. What `fit` finds besides is kept in buffers: `scale`,
    the unit of length, and `origin`, so that results come back in the user's units; `image_covariance`, to fill
    in hidden points; and the shape prior (`prior`).
    The weights start Glorot-uniform as in the authors' code, drawn from `generator`; thresholds and S̄
    start at zero.
    """

    def __init__(self, config=None, *, n_points=None, generator=None):
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
        self.register_buffer("scale", torch.ones(()))
        self.register_buffer("origin", torch.zeros(2))
        self.register_buffer("image_covariance", torch.eye(P) - 1 / P)
        n = 1 + KINDS
        self.register_buffer("prior_mean", torch.zeros(n, P, 3))
        self.register_buffer("prior_covariance", torch.zeros(n, 3 * P, 3 * P))
        self.register_buffer("prior_noise", torch.zeros(n))  # zero: not in use
        self._draw_weights(generator)

    def _draw_weights(self, generator):

        def glorot(parameter, fan_in, fan_out):
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
    def coherence(self):
        """Mutual coherence of the last dictionary, a quality measure that needs no truth (chapter 10)."""
        D = self.D[-1]
        return mutual_coherence(D if D.ndim == 2 else D.flatten(1).T)

    @property
    def prior(self):
        """The shape prior that `fit` learned with the network, a tuple of `shape_prior.Gaussian`, or None."""
        each = zip(self.prior_mean, self.prior_covariance, self.prior_noise, strict=True)
        return tuple(Gaussian(m.double().cpu(), C.double().cpu(), s.item()) for m, C, s in each if s > 0) or None

    @prior.setter
    def prior(self, prior):
        self.prior_noise.zero_()
        for i, gaussian in enumerate(prior):
            self.prior_mean[i], self.prior_covariance[i] = gaussian.mean, gaussian.covariance
            self.prior_noise[i] = gaussian.noise

    def encode(self, X):
        """Block sparse code of images (B, P, 2) as `normalize` makes them: Psi_N (B, 2, 3, K_N); 4×2 (B, 2, 4, K_N).

        One step of block ISTA per layer. The columns of a block come before its rows here, so that
        every layer is one matrix product over the flattened batch (chapter 06).
        """
        B, P, _ = X.shape
        n = 2 * self.config.block_rows * B
        Z = X.mT.reshape(2 * B, P) @ self.first_dictionary()  # (2B, rows K₁)
        Z = self._threshold(Z.view(n, -1), self.encoder_threshold[0])  # (n, K₁)
        for D, b in zip(list(self.D)[1:], list(self.encoder_threshold)[1:], strict=True):
            Z = self._threshold(Z @ D, b)  # (n, K_i)
        return Z.view(B, 2, self.config.block_rows, -1)

    def first_dictionary(self):
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

    def _threshold(self, x, b):
        """η(x; b), one threshold per atom."""
        above = torch.relu(x - b)
        return above if self.config.threshold == "relu" else above - torch.relu(-x - b)

    def bottleneck(self, Psi):
        """Sparse code and camera of Psi_N (B, 2, rows, K): psi (B, K) and M (B, 3, 2), orthonormal."""
        B, _, rows, K = Psi.shape
        full = self.config.beta == "full"
        psi = Psi.reshape(B, -1) @ self.beta if full else self.beta @ Psi.reshape(B, 2 * rows, K)
        if self.config.threshold == "soft":
            # The picture turned by 180°, −W, shows the same shape. With odd thresholds every block changes
            # its sign, and so does M, as it must; the code must not (chapter 09).
            psi = psi.abs()
        return psi, nearest_orthonormal((Psi @ self.gamma)[:, :, :3].mT)

    def decode(self, psi):
        """Shape of a sparse code, in normalised units: (B, K_N) -> (B, P, 3)."""
        for D, b in zip(list(self.D)[:0:-1], list(self.decoder_threshold)[::-1], strict=True):
            psi = self._threshold(psi @ D.mT, b)  # (B, K_{i-1})
        S = psi @ self.D[0].flatten(1)  # (B, 3P)
        return S.view(-1, *self.output_bias.shape) + self.output_bias

    def scaled(self, W, visible):
        """Points in the network's unit: X (B, P, 2) as in `normalize`; the mean (B, 2) and the scale (B,) taken out."""
        X, mean = preprocessing.center(W, visible)
        if self.config.projection == "orthographic":
            scale = self.scale.expand(X.shape[0])  # not len(X), which `torch.export` would fix
        else:
            scale = preprocessing.frame_scale(X, visible)
        return X / scale[:, None, None], mean, scale

    def normalize(self, W, visible):
        """From image coordinates to the network's.

        Returns
        -------
        image : (B, P, 2)
            What the encoder takes: hidden points filled in, centred but for a model of translations.
        X : (B, P, 2)
            Points centred over the visible ones, zero where hidden: what the loss and the prior compare with.
        scale : (B,)
        """
        X, mean, scale = self.scaled(W, visible)
        if not torch.compiler.is_exporting() and (visible == 1).all():
            image = X  # the shortcut is the same, but an exported graph has no branches
        elif self.config.fill == "likely":
            image = completion.fill(self.image_covariance.double(), X, visible)
        else:
            weight = visible.to(X.dtype)
            unit = weight.mean(1, keepdim=True) if self.config.fill == "scaled" else 1.0
            image = X * (weight / unit)[..., None]
        if self.config.translation:
            moved = preprocessing.visible_mean(X - image, visible)  # back to where the visible points are
            image = image + (moved + (mean - self.origin) / scale[:, None])[:, None]
            if self.config.fill != "likely":
                image = image * (visible > 0)[..., None]
        return image, X, scale

    def forward(self, W, visible=None):
        """Shapes, cameras and translations of image points.

        Parameters
        ----------
        W : (B, P, 2) tensor in image coordinates
        visible : (B, P) tensor, optional
            Bool, or weights from 0 to 1.

        Returns
        -------
        S : (B, P, 3), centred over the points; M : (B, 3, 2); t : (B, 2)
            In the units of W; ``S @ M + t[:, None]`` reprojects.
        """
        if visible is None:
            visible = torch.ones(W.shape[:2], dtype=torch.bool, device=W.device)
        image, _, scale = self.normalize(W, visible)
        psi, M = self.bottleneck(self.encode(image))
        S = self.decode(psi)
        S = (S - S.mean(1, keepdim=True)) * scale[:, None, None]
        t = preprocessing.visible_mean(W - S @ M, visible)  # the best t in closed form
        return S, M, t

    def save(self, path):
        """Write configuration and weights to one file that holds no code; returns its path."""
        path = Path(path)
        weights = {key: value.detach().cpu() for key, value in self.state_dict().items()}
        torch.save({"config": asdict(self.config), "weights": weights}, path)
        return path

    @classmethod
    def load(cls, path):
        """The network that `save` wrote, on the CPU and in evaluation mode.

        Raises FileNotFoundError if there is no such file, ValueError if it is not a saved network.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file.")
        try:
            saved = torch.load(path, weights_only=True, map_location="cpu")
            return cls.from_arrays(saved["config"], saved["weights"])
        except Exception as error:  # torch raises many kinds for a broken file
            raise ValueError(f"{path}: not a saved network, or a broken one ({type(error).__name__}).") from None

    def to_onnx(self, path):
        """Write the forward pass as ONNX, for any number of frames: W and visible in; S, M and t out.

        Needs the packages onnx and onnxscript (``pip install nrsfm-lite[onnx]``). Returns the path.
        """
        W = torch.zeros(2, self.config.n_points, 2, dtype=self.scale.dtype, device=self.scale.device)
        W[:, 0, 0], W[:, 1, 1] = 1, 1  # any two frames that are not a point
        visible = torch.ones(W.shape[:2], dtype=torch.bool, device=W.device)
        frames = {0: torch.export.Dim("frames", min=1)}
        program = torch.export.export(self, (W, visible), dynamic_shapes=(frames, frames))
        names = {"input_names": ["W", "visible"], "output_names": ["S", "M", "t"]}
        torch.onnx.export(program, dynamo=True, verbose=False, **names).save(str(path))
        return Path(path)

    def to_arrays(self):
        """(config, weights) as a dict and a dict of NumPy arrays: all that `from_arrays` needs."""
        return asdict(self.config), {k: v.detach().cpu().numpy() for k, v in self.state_dict().items()}

    @classmethod
    def from_arrays(cls, config, weights):
        """The network that `to_arrays` took apart."""
        weights = {k: torch.as_tensor(v) for k, v in weights.items()}
        net = cls(Config(**config), generator=torch.Generator()).to(weights["scale"].dtype)
        # Files of earlier versions lack these.
        older = {k: v for k, v in net.state_dict().items() if k.startswith(("prior_", "origin", "image_"))}
        net.load_state_dict(older | weights)
        return net.eval()


data.network_from_arrays = DeepNRSfM.from_arrays
