"""Paths of a user's own, beside the library's straight one."""

import math

import torch

from warmprior import Interpolant


class TrigonometricInterpolant(Interpolant):
    name = "trigonometric"

    def coefficients(self, t):
        w = math.pi / 2
        sin, cos = torch.sin(w * t), torch.cos(w * t)
        return cos, sin, -w * sin, w * cos


class PolynomialInterpolant(Interpolant):
    name = "polynomial"

    def __init__(self, n=2.0):
        self.n = n

    def coefficients(self, t):
        beta, speed = t**self.n, self.n * t ** (self.n - 1)
        return 1 - beta, beta, -speed, speed
