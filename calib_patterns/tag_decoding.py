"""Reading the bits of square tags: each candidate quadrilateral is sampled through its homography and compared with the codes of
the board's own tags.

OpenCV's detector decodes the image it searches. That image is widened for tags whose corners touch other black, which costs small
tags their black bits; here the bits are read from the photo itself, where bits of 2.5 px are still told apart.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from calib_patterns.options import TagOptions

_SAMPLES = np.array([-0.2, 0.0, 0.2])
"""Places inside a cell, from its middle, in cells."""


@dataclass(frozen=True)
class Codes:
    """Black cells of the tags of a board, the border included, and how many wrong bits are put right."""

    black: Bool[np.ndarray, "tags n n"]
    border_bits: int
    max_wrong_bits: int


def _homographies(quads: Float[np.ndarray, "n 4 2"]) -> Float[np.ndarray, "n 3 3"]:
    """From the unit square, clockwise from its top left, to each quadrilateral."""
    x, y = np.array([0.0, 1.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0, 1.0])
    zero, one = np.zeros(4), np.ones(4)
    fixed_u, fixed_v = np.stack([x, y, one, zero, zero, zero], -1), np.stack([zero, zero, zero, x, y, one], -1)
    place = np.stack([x, y], -1)
    rows_u = np.concatenate([np.broadcast_to(fixed_u, (len(quads), 4, 6)), -place * quads[..., :1]], -1)
    rows_v = np.concatenate([np.broadcast_to(fixed_v, (len(quads), 4, 6)), -place * quads[..., 1:]], -1)
    matrix = np.concatenate([rows_u, rows_v], 1)
    right = np.concatenate([quads[..., 0], quads[..., 1]], 1)
    solution = np.linalg.solve(matrix, right[..., None])[..., 0]
    return np.concatenate([solution, np.ones((len(quads), 1))], 1).reshape(-1, 3, 3)


def _cells_grey(image: np.ndarray, quads: Float[np.ndarray, "n 4 2"], side: int) -> Float[np.ndarray, "n side side"]:
    """Mean grey level of the middle of every cell."""
    places = ((np.arange(side)[:, None] + 0.5 + _SAMPLES) / side).ravel()
    x, y = np.meshgrid(places, places)
    unit = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    seen = unit @ _homographies(quads).transpose(0, 2, 1)
    pixels = (seen[..., :2] / seen[..., 2:]).astype(np.float32)
    # Rows of one candidate each, in pieces that cv2.remap takes.
    grey = [
        cv2.remap(image, part[..., 0], part[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for part in _pieces(pixels)
    ]
    fine = np.concatenate(grey).reshape(-1, side, len(_SAMPLES), side, len(_SAMPLES))
    return fine.astype(np.float64).mean((2, 4))


def likeness(image: np.ndarray, quads: Float[np.ndarray, "n 4 2"], codes: Codes, tags: Int[np.ndarray, " n"]) -> float:
    """Correlation of the grey levels inside at least one quadrilateral with the bits of the tags that should be there: 1 where
    they are seen sharply, less with blur, about 0 with other tags.

    `image`: (h, w) grey, 8 bits. `quads`: corners clockwise from the tag's own top left.
    """
    border = codes.border_bits
    inner = np.s_[:, border:-border, border:-border]
    grey = _cells_grey(image, quads, codes.black.shape[1])[inner].reshape(len(quads), -1)
    white = 1.0 - codes.black[tags][inner].reshape(len(quads), -1)
    grey, white = (values - values.mean(1, keepdims=True) for values in (grey, white))
    return float(np.sum(grey * white) / max(np.linalg.norm(grey) * np.linalg.norm(white), 1e-9))


def _pieces(pixels: np.ndarray) -> list[np.ndarray]:
    return [pixels[k : k + 4096] for k in range(0, len(pixels), 4096)]


def decode(
    image: np.ndarray, quads: Float[np.ndarray, "n 4 2"], codes: Codes, options: TagOptions
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"], Float[np.ndarray, "m 4 2"]]:
    """Which candidates are tags: (rows of `quads`, tags, corners clockwise from the tag's own top left).

    `image`: (h, w) grey, 8 bits. `quads`: convex, clockwise as seen (u to v).
    """
    side, border = codes.black.shape[1], codes.border_bits
    nothing = np.zeros(0, dtype=np.int64)
    if not len(quads):
        return nothing, nothing, quads
    grey = _cells_grey(image, quads, side)
    inner = np.s_[:, border:-border, border:-border]
    rim = np.ones((side, side), dtype=bool)
    rim[border:-border, border:-border] = False
    black_level = np.median(grey[:, rim], axis=1)
    white_level = np.percentile(grey[inner].reshape(len(quads), -1), 90, axis=1)
    threshold = (0.5 * (black_level + white_level))[:, None, None]
    border_errors = (grey > threshold)[:, rim].mean(1)
    read = (grey[inner] <= threshold).reshape(len(quads), -1)
    turned = np.stack([np.rot90(codes.black[inner], turn, axes=(1, 2)).reshape(len(codes.black), -1) for turn in range(4)])
    # Wrong bits of every candidate against every tag and turn: |a - b| = a + b - 2 a b.
    a, b = read.astype(np.float64), turned.reshape(-1, read.shape[1]).astype(np.float64)
    wrong = a.sum(1)[:, None] + b.sum(1) - 2.0 * a @ b.T
    best = wrong.argmin(1)
    is_tag = wrong.min(1) <= codes.max_wrong_bits + 0.5
    is_tag &= (border_errors <= options.max_border_errors) & (white_level - black_level >= options.min_contrast_grey)
    rows = np.flatnonzero(is_tag)
    turn, tag = np.divmod(best[rows], len(codes.black))
    # A tag turned by 90 degrees against the clock has its own top left at the bottom left: the last corner.
    corners = quads[rows[:, None], (np.arange(4) - turn[:, None]) % 4]
    return rows, tag, corners
