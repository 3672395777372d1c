"""Whether a table of numbers can be a covariance."""

import torch
from torch import Tensor


def covariance_fault(covariance: Tensor) -> str:
    """What forbids that a square table (n, n) of numbers is a covariance; empty where nothing does.

    Units differ by orders between the rows: each counts in its own standard deviation.
    """
    # files that keep single precision, or its seven digits, round each correlation by that much; an eigenvalue moves by
    # no more than the size of the table times the error of an entry
    slack = len(covariance) * torch.finfo(torch.float32).eps
    variance = covariance.diagonal()
    largest = covariance.abs().max().clamp_min(torch.finfo(covariance.dtype).tiny)
    scale = torch.where(variance > 0, variance, largest).sqrt()
    scaled = covariance / scale[:, None] / scale
    if bool(((scaled - scaled.mT).abs() > slack).any()):
        return "is not symmetric"
    # a correlation beyond one is looked for first: what is not finite has no eigenvalues
    beyond = (variance < 0).any() | ~(scaled.abs() <= 1 + slack).all()
    if bool(beyond) or bool(torch.linalg.eigvalsh(scaled)[0] < -slack):
        return "has a negative eigenvalue"
    return ""
