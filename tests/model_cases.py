"""Bearings and pixels at which camera models are looked at."""

import math

import numpy as np
import torch


def axis_sign(model) -> float:
    return float(torch.sign(model._unproject(model.centre_px)[0][2]))


def bearings_of(model, count=4000, seed=0, share=0.999, least=0.0):
    """Unit bearings spread over the domain of the model."""
    rng = np.random.default_rng(seed)
    theta = least + rng.uniform(0, 1, count) * (share * min(model.max_angle, math.radians(115)) - least)
    phi = rng.uniform(-np.pi, np.pi, count)
    xyz = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    return xyz * [1, 1, axis_sign(model)]


def image_pixels(model, count=3000, seed=1):
    rng = np.random.default_rng(seed)
    w, h = model.image_size
    return rng.uniform([-0.5, -0.5], [w - 0.5, h - 0.5], (count, 2))
