"""Least squares and sums that end alike in every run, on any number of threads.

torch's usual driver on the CPU (gelsy) ends otherwise in the last digits from process to process, by where its workspace happens
to lie in memory; what is refined from there then differs in the tenth digit. The divide and conquer of gelsd does not.

From 32768 numbers on torch sums them all in as many parts as it has threads. Sums along an axis, of which several are left, are
not divided.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor


def least_squares(matrix: Float[Tensor, "*batch n p"], right: Float[Tensor, "*batch n k"]) -> Float[Tensor, "*batch p k"]:
    """The shortest x that minimises |matrix x - right|, on the CPU."""
    return torch.linalg.lstsq(matrix, right, driver="gelsd").solution


def total(values: Float[Tensor, "*shape"]) -> float:
    """The sum of all values."""
    if values.device.type != "cpu":
        return float(values.sum())
    # Infinite values of both signs, as of what observations leave open, add up to NaN without a word, as torch has it.
    with np.errstate(invalid="ignore"):
        return float(values.detach().numpy().sum())
