"""The transient mask of Ha-NeRF: an MLP that knows which photo it is asked about, and where in it.

It never sees a colour. What it knows of a training photo it has learned from that photo's errors alone, so a photo
that was not trained on has no mask.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from model.encoding import positional_encoding
from model.methods import VIEW_CODE

FREQUENCIES = 10
WIDTH = 256


class UVMask(nn.Module):
    """An embedding for each photo, then 241,409 parameters that all photos share (released code of Ha-NeRF).

    Args:
        photos: number of training photos.
    """

    def __init__(self, photos: int) -> None:
        super().__init__()
        self.embedding = nn.Embedding(photos, VIEW_CODE)
        self.layers = nn.Sequential(
            nn.Linear(VIEW_CODE + 2 * (1 + 2 * FREQUENCIES), WIDTH),
            nn.ReLU(),
            nn.Linear(WIDTH, WIDTH),
            nn.ReLU(),
            nn.Linear(WIDTH, WIDTH),
            nn.ReLU(),
            nn.Linear(WIDTH, WIDTH),
            nn.ReLU(),
            nn.Linear(WIDTH, 1),
        )

    def forward(self, photo: Tensor, uv: Tensor) -> Tensor:
        """M (P, N) in (0, 1), 1 = transient.

        photo: (P,) int64, indices below `photos`. uv: (P, N, 2), pixels as (row / height, column / width) in [0, 1).
        """
        where = positional_encoding(uv, FREQUENCIES)
        who = self.embedding(photo)[:, None].expand(-1, uv.shape[1], -1)
        return self.layers(torch.cat([who, where], dim=-1)).squeeze(-1).sigmoid()
