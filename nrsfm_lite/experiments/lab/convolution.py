"""The network as the paper writes it: transposed convolutions and a singular value decomposition.

Kept to compare with (`speed`, chapter 06); the package itself uses matrix products and the polar factor.
"""

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, conv_transpose2d

from ...model import DeepNRSfM


class ConvolutionNet(nn.Module):
    """The same function of the same weights as a `DeepNRSfM` with 3×2 blocks and ReLU.

    The image is a 1×2 picture with P channels, a block code a 3×2 picture with K_i channels (paper,
    section on implementation). The weights are copied from `net`.
    """

    def __init__(self, net: DeepNRSfM) -> None:
        super().__init__()
        first, *rest = (D.detach().clone() for D in net.D)
        kernels = [first.permute(1, 0, 2)[..., None], *(D[..., None, None] for D in rest)]
        self.kernels = nn.ParameterList([nn.Parameter(k.contiguous()) for k in kernels])
        self.encoder_threshold = nn.ParameterList([nn.Parameter(b.detach().clone()) for b in net.encoder_threshold])
        self.decoder_threshold = nn.ParameterList([nn.Parameter(b.detach().clone()) for b in net.decoder_threshold])
        self.beta, self.gamma, self.output_bias = (
            nn.Parameter(p.detach().clone()) for p in (net.beta, net.gamma, net.output_bias)
        )

    def forward(self, X: Tensor) -> tuple[Tensor, Tensor]:
        """Shapes (B, P, 3) and cameras (B, 3, 2) of normalised points (B, P, 2)."""
        Psi = X[:, :, None]  # (B, P, 1, 2)
        for kernel, b in zip(self.kernels, self.encoder_threshold, strict=True):
            Psi = torch.relu(conv_transpose2d(Psi, kernel) - b[:, None, None])  # (B, K_i, 3, 2)
        A = torch.einsum("bkij,k->bij", Psi, self.gamma)
        U, _, Vh = torch.linalg.svd(A, full_matrices=False)
        blocks = Psi.permute(0, 3, 2, 1).flatten(1)  # in the package's order (B, 2, 3, K)
        psi = (blocks @ self.beta)[:, :, None, None]  # (B, K_N, 1, 1)
        for kernel, b in zip(self.kernels[:0:-1], self.decoder_threshold[::-1], strict=True):
            psi = torch.relu(conv2d(psi, kernel) - b[:, None, None])
        S = conv_transpose2d(psi, self.kernels[0].transpose(0, 1))[..., 0]  # (B, P, 3)
        return S + self.output_bias, U @ Vh
