"""What tests ask of processes."""

from __future__ import annotations

from pathlib import Path


def ended(pid):
    state = Path(f"/proc/{pid}/stat")
    return not state.exists() or state.read_text().split()[2] == "Z"
