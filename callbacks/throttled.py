"""Base class of callbacks that act rarely, because acting takes longer than a step."""

from __future__ import annotations

import time
from abc import abstractmethod
from typing import Any, ClassVar

from stable_baselines3.common.logger import CSVOutputFormat, HumanOutputFormat, JSONOutputFormat, KVWriter, Logger

from sb3_knntd.base import KNNAlgorithm
from sb3_knntd.common.callback_dispatcher import BatchedCallback
from sb3_knntd.common.checks import check_integer, check_verbose

#: ``freq=None``: number of calls after which the clock is read.
CALLS_PER_CLOCK_READ = 128


class ThrottledCallback(BatchedCallback):
    """
    Acts every ``freq`` calls, or as often as a share of the time allows, and at the end of training.

    :param name: name of the argument ``freq`` in the subclass, for messages
    :param freq: act every ``freq`` calls (of n_envs steps each); ``None``: as often as acting takes :attr:`SHARE` of
        the time
    :param verbose: 0 for no output, 1 to print a line for each written file
    :raises ValueError: if ``freq`` is neither ``None`` nor an integer >= 1, or ``verbose`` is invalid
    """

    model: KNNAlgorithm

    #: ``freq=None``: the share of the training time that acting may take.
    SHARE: ClassVar[float] = 0.001
    #: ``freq=None``: seconds that acting is assumed to take the first time.
    FIRST_SECONDS: ClassVar[float]

    def __init__(self, name: str, freq: int | None, verbose: int) -> None:
        super().__init__(check_verbose(verbose))
        self.freq = None if freq is None else check_integer(name, freq, 1)

    def init_callback(self, model: Any) -> None:
        """
        :param model: the model that is about to learn
        :raises ValueError: if it is not a model of this package
        """
        if not isinstance(model, KNNAlgorithm):
            raise ValueError(
                f"{type(self).__name__} needs a model of KNNTD, ExA or KNNDyna; got a {type(model).__name__}"
            )
        super().init_callback(model)

    def _on_training_start(self) -> None:
        self._acted_at = self.n_calls
        self._seconds = self.FIRST_SECONDS
        self._spent = 0.0
        self._start = time.perf_counter()
        self.due_at = self._next_due()

    def _on_step(self) -> bool:
        if self._is_time():
            start = time.perf_counter()
            self._acted_at = self.n_calls
            self._act()
            self._seconds = time.perf_counter() - start
            self._spent += self._seconds
        self.due_at = self._next_due()
        return True

    def _is_time(self) -> bool:
        if self.freq is None:
            return (time.perf_counter() - self._start) * self.SHARE >= self._spent + self._seconds
        return self.n_calls % self.freq == 0

    def _next_due(self) -> int:
        """The next call at which :meth:`_is_time` must be checked."""
        return self.n_calls + (CALLS_PER_CLOCK_READ if self.freq is None else self.freq - self.n_calls % self.freq)

    def _on_training_end(self) -> None:
        if self.n_calls > self._acted_at:
            self._acted_at = self.n_calls
            self._act()

    @abstractmethod
    def _act(self) -> None:
        """Perform the action of this callback."""


def picture_formats(logger: Logger) -> list[KVWriter]:
    """
    :param logger: SB3's logger
    :return: its outputs that can show images: TensorBoard, and outputs that are not part of SB3
    """
    text = HumanOutputFormat, JSONOutputFormat, CSVOutputFormat
    return [output for output in logger.output_formats if not isinstance(output, text)]


def write(outputs: list[KVWriter], key: str, value: Any, step: int) -> None:
    """
    Write one value now, instead of with the algorithm's next log, since it belongs to this step.

    :param outputs: outputs of the logger, see :func:`picture_formats`
    :param key: its key in the log
    :param value: a number, or SB3's ``Image`` or ``HParam``
    :param step: number of environment steps
    """
    for output in outputs:
        output.write({key: value}, {key: ()}, step)
