"""What a robot's messages do wrong: said once, in the log and as an event, and counted. Bounded."""

import logging
from collections import Counter
from collections.abc import Callable

from flocc_agent.runtime.facts import RosProblem

logger = logging.getLogger(__name__)

SENTENCES_MAX = 64


class Problems:
    """Says each sentence once."""

    def __init__(self, report: Callable[[RosProblem], None]) -> None:
        self.counts = Counter[str]()
        self._report = report
        self._said: set[str] = set()

    def refuse(self, kind: str, where: str, sentence: str) -> None:
        """Count a message that cannot be used, and say why."""
        self.counts[f"{kind} refused"] += 1
        self.say(where, sentence)

    def say(self, where: str, sentence: str) -> None:
        """Say something of a topic once."""
        told = f"{where}: {sentence}"
        if told in self._said or len(self._said) >= SENTENCES_MAX:
            return
        self._said.add(told)
        logger.warning("%s", told)
        self._report(RosProblem(sentence=told))
