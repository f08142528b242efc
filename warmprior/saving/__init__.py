"""Policies on disk and on the Hugging Face hub, and their model cards."""

from warmprior.saving.card import model_card
from warmprior.saving.policies import load_policy, push_policy, save_policy

__all__ = [
    "load_policy",
    "model_card",
    "push_policy",
    "save_policy",
]
