"""How long to wait before something that died at once is started yet again."""

from __future__ import annotations

import time
from collections.abc import Callable

#: Seconds between the first start and the next; they double with every start ...
FIRST_S = 1.0
#: ... up to so many.
LONGEST_S = 60.0
#: What has lived for so long did not die of its start.
LIVED_S = 60.0


class GrowingPause:
    """Between starts of something that ought to live: 1, 2, 4 ... 60 s, and 1 s again once it has lived.

    Parameters
    ----------
    clock
        Monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._started, self._pause = clock(), FIRST_S

    def lives(self) -> None:
        """It lives; to be told now and then."""
        if self._clock() - self._started >= LIVED_S:
            self._pause = FIRST_S

    def over(self) -> bool:
        """Whether it may be started again."""
        return self._clock() - self._started >= self._pause

    def start(self) -> float:
        """It is started again now; seconds that it has to wait for the next time if it dies at once."""
        self._started, self._pause = self._clock(), min(2 * self._pause, LONGEST_S)
        return self._pause
