"""What identifies a dataclass of options, while it grows."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

from warmprior.io.options import LATER, identity_of, variations


@dataclass
class Inner:
    width: int = 1
    depth: int = field(default=2, metadata=LATER)


@dataclass
class Outer:
    inner: Inner = field(default_factory=Inner)
    names: tuple[str, ...] = ("a",)
    speed: float | None = field(default=None, metadata=LATER)


def test_later_options_are_left_out_at_their_defaults_alone():
    assert identity_of(Outer()) == {"inner": {"width": 1}, "names": ("a",)}
    assert variations(Outer(inner=Inner(width=5), names=())) == {}
    changed = Outer(inner=Inner(depth=3), speed=0.0)
    assert identity_of(changed) == asdict(changed)
    assert variations(changed) == {"depth": 3, "speed": 0.0}
