"""This module tells what a policy is trained on: what it sees, what is left out, and what its actions are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain

from warmprior.checks import check_finite_numbers, check_positive, check_whole_numbers, given

AS_RECORDED = ", as recorded"
"""The end of the words for actions whose meaning is unknown."""


def image_words(shape: Sequence[int], size: int, resize: str) -> str:
    """Return what becomes of images of a height and width, given the options of their size.

    Examples:
        >>> from warmprior.modules.recording import image_words
        >>> image_words((84, 84), 84, "squeeze"), image_words((480, 640), 84, "pad")
        ('84 x 84', '480 x 640, seen at 84 x 84 (pad)')
    """
    words = " x ".join(map(str, shape))
    return words if (*shape,) == (size, size) else f"{words}, seen at {size} x {size} ({resize})"


@dataclass(frozen=True)
class Recording:
    """A description of what a policy is trained on, which JSON can hold.

    Attributes:
        name: name of the demonstrations.
        demonstrations: their number, without those held out.
        steps: their number of steps.
        actions: what the actions are, in words.
        observations: the width of each observation, in the order of the policy's vector.
        images: the size of each image in words.
        names: the dataset's own names of images that have another here.
        left_out: what the policy does not see, by the option that would take it, or under no name.
        rate: control steps per second, if they are known.
        held_out: number of further demonstrations that are held out.
        numbers: the dataset's own names of the numbers of observations, and of ``"action"``, in their order.
        ranges: the lowest and the highest number of each observation, and of ``"action"``, raw units.
        sizes: height and width of each image as it is recorded.

    Raises:
        ValueError: if an entry has another form.

    Examples:
        >>> from warmprior.modules.recording import Recording
        >>> seen = Recording("so101", 2, 60, "[6], as recorded", {"state": 6}, left_out={"images": ["front"]})
        >>> print(seen.text())
        data          so101: 2 demonstrations, 60 steps
        observations  state [6]
        images        none
        left out      front (images=)
        actions       [6], as recorded (joints= names what absolute joint targets set)
        rate          unknown
    """

    name: str
    demonstrations: int
    steps: int
    actions: str
    observations: Mapping[str, int]
    images: Mapping[str, str] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    left_out: Mapping[str, Sequence[str]] = field(default_factory=dict)
    rate: float | None = None
    held_out: int = 0
    numbers: Mapping[str, Sequence[str]] = field(default_factory=dict)
    ranges: Mapping[str, Sequence[float]] = field(default_factory=dict)
    sizes: Mapping[str, Sequence[int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        counts = {"demonstrations": self.demonstrations, "steps": self.steps, "held_out": self.held_out}
        check_whole_numbers(0, **counts, **self.observations)
        check_positive(**given(rate=self.rate))
        if not all(
            isinstance(ends, Sequence) and len(ends) == 2
            for ends in (*self.ranges.values(), *self.sizes.values())
        ):
            raise ValueError(f"ranges and sizes must be pairs of numbers, got {self.ranges} and {self.sizes}")
        for name, (low, high) in self.ranges.items():
            check_finite_numbers(**{f"the least {name}": low, f"the largest {name}": high})
        for name, (height, width) in self.sizes.items():
            check_whole_numbers(**{f"the height of {name}": height, f"the width of {name}": width})
        texts = *self.images.values(), *self.names.values(), *chain(*self.left_out.values())
        texts = *texts, *chain(*self.numbers.values())
        if not all(isinstance(text, str) for text in (self.name, self.actions, *texts)):
            raise ValueError(f"names of a recording must be text, got {self}")

    def lines(self, option: str = "{}=") -> dict[str, str]:
        """Return the lines to print by their titles; ``option`` is the form of an option's name."""
        left_out = [
            f"{', '.join(names)} ({option.format(taken_by) if taken_by else 'no option takes it'})"
            for taken_by, names in self.left_out.items()
        ]
        total = self.demonstrations + self.held_out
        demonstrations = "1 demonstration" if total == 1 else f"{total} demonstrations"
        if self.held_out:
            demonstrations = f"{self.demonstrations} of {demonstrations}, {self.held_out} held out"
        hint = f" ({option.format('joints')} names what absolute joint targets set)"
        return {
            "data": f"{self.name}: {demonstrations}, {self.steps:,} steps",
            "observations": ", ".join(f"{name} [{width}]" for name, width in self.observations.items()),
            "images": "; ".join(f"{name}, {size}" for name, size in self.images.items()) or "none",
            "left out": "; ".join(left_out) or "nothing",
            "actions": self.actions + (hint if self.actions.endswith(AS_RECORDED) else ""),
            "rate": "unknown" if self.rate is None else f"{self.rate:g} control steps per second",
        }

    def text(self, option: str = "{}=") -> str:
        """Return :meth:`lines` below each other."""
        return "\n".join(f"{title:13} {line}" for title, line in self.lines(option).items())
