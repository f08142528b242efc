"""How a policy is played: at once, as simulators allow, or late, and guided or not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from warmprior.modules.real_time_chunking import RealTimeChunking

__all__ = ["AT_ONCE", "Condition"]


@dataclass(frozen=True)
class Condition:
    """What is the same in all episodes of a cell, beside the policy and its integration.

    Attributes:
        delay: control steps until chunks take effect; ``None`` where the simulator waits.
        execute: actions executed per decision; all ``H`` by default.
        guidance: of the flow.

    See Also:
        - :class:`~warmprior.InferenceDelay`: lets chunks take effect late.
        - :class:`~warmprior.RealTimeChunking`: guides late chunks.

    Examples:
        >>> late = Condition(delay=2, execute=4, guidance=RealTimeChunking())
        >>> late.facts()
        {'execute': 4, 'delay': 2, 'guidance': 'rtc'}
    """

    delay: int | None = None
    execute: int | None = None
    guidance: RealTimeChunking | None = None

    def facts(self) -> dict[str, Any]:
        """What rows tell of it: nothing of the usual one.

        Examples:
            >>> AT_ONCE.facts(), Condition(delay=2, execute=4).facts()
            ({}, {'execute': 4, 'delay': 2, 'guidance': 'none'})
        """
        if self == AT_ONCE:
            return {}
        guidance = "none" if self.guidance is None else "rtc"
        return {"execute": self.execute, "delay": self.delay, "guidance": guidance}


AT_ONCE = Condition()
"""The usual condition: the simulator waits for the policy."""
