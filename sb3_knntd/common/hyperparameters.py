"""Hyperparameters of an algorithm as descriptors, which apply or refuse changes after construction."""

from __future__ import annotations

from typing import Any, Protocol


class Configurable(Protocol):
    """A class with hyperparameters."""

    #: whether the model has been built
    _is_set_up: bool

    def _reconfigure(self) -> None:
        """Check all hyperparameters and apply them."""


class Hyperparameter:
    """A hyperparameter that can be set at any time and applies from the next step on."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, model: Any, owner: type) -> Any:
        if model is None:
            return self
        try:
            return model.__dict__[self.name]
        except KeyError:
            raise AttributeError(f"{owner.__name__} has no {self.name} yet") from None

    def __set__(self, model: Configurable, value: Any) -> None:
        before = model.__dict__.get(self.name)
        model.__dict__[self.name] = value
        if not getattr(model, "_is_set_up", False):
            return
        try:
            model._reconfigure()
        except ValueError:
            model.__dict__[self.name] = before
            model._reconfigure()
            raise


class FixedHyperparameter(Hyperparameter):
    """A hyperparameter that determines how the table is built and cannot be set afterwards."""

    def __set__(self, model: Configurable, value: Any) -> None:
        if getattr(model, "_is_set_up", False):
            raise AttributeError(
                f"{self.name} cannot be changed: the table was built with it. Make another model, "
                f"{type(model).__name__}(env, {self.name}={value!r:.100})"
            )
        super().__set__(model, value)
