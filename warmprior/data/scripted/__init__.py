"""Scripted experts that generate demonstrations where no official data are at hand."""

from __future__ import annotations

from warmprior.data.scripted.generate import GENERATOR_VERSION, generate_demonstrations

__all__ = ["GENERATOR_VERSION", "generate_demonstrations"]
